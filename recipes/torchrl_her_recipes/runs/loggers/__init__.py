"""Opens TorchRL's loggers for ``log=NAME``, so that resumed runs continue in them, and logs runs to them."""
