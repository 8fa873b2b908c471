"""What is drawn with GL: imgui's lists, the preview, lines over it."""
