"""What other processes give."""
