"""One sitting: the window, the worker, and what the command line asked for."""
