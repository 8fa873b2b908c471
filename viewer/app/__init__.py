"""The window's loop and the parts that it draws."""
