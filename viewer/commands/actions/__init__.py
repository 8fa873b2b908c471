"""The commands, one file per group. The registry finds every file in this folder."""
