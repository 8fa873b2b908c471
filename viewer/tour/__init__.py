"""Tours: steps of Markdown that move the camera, open rays, show live numbers and notice what is done."""
