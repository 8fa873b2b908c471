"""The worker thread behind a window: training, previews and opened rays."""
