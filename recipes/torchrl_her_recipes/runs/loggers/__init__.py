"""The loggers that ``log=`` names: each opens one of TorchRL's so that a resumed run goes on in it."""
