"""Files of tensors and plain data: read without executing anything, and written whole or not at all."""
