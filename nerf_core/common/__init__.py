"""What knows nothing of radiance fields: errors, files, signals, the command line, plug-in registries."""
