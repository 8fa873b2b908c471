"""Training steps, runs, checkpoints and evaluation."""
