"""What is known about a capture before anything is trained: its report."""
