"""Opens TorchRL's loggers for ``log=NAME``, which a resumed run continues, and logs runs to them."""
