"""From gymnasium to TorchRL, and back."""
