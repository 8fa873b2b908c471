"""Jobs that write files from a model while training continues."""
