"""What a run is to be: plain values. Nothing in here imports torch."""
