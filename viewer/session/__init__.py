"""A session: the window, the worker, and the wishes of the command line."""
