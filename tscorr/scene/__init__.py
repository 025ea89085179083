"""One scene: plan, read, correct, write, in a bounded pipeline."""
