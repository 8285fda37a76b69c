"""The loggers for ``log=NAME``: each opens one of TorchRL's so that a resumed run continues in it."""
