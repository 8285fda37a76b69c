"""Conversion of environments from gymnasium to TorchRL, and back."""
