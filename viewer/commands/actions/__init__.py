"""The commands, a file for each group; every file in this folder is found by the registry."""
