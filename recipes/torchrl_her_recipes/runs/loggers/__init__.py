"""Opens TorchRL's loggers for ``log=NAME``, in a way that resumed runs continue them, and logs runs."""
