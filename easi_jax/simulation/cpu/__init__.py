"""What makes MJX fast on a CPU."""
