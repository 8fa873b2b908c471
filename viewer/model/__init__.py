"""What the window knows: its state, its camera, its pinned rays."""
