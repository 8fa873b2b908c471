"""Pictures and files from a trained model."""
