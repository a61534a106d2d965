"""Learning from recordings and twin data: labels, graphs as tensors."""
