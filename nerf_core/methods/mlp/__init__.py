"""The paper's network and its optimiser; methods place its samples."""
