"""HERWriter and HERSampleUnit beside the other parts of TorchRL: each pair works, or it is refused."""
