"""Loggers of TorchRL for ``log=NAME``, opened so that a resumed run continues in them, and what they get."""
