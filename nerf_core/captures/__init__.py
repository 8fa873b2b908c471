"""Photos and videos without poses, and what a capture is like."""
