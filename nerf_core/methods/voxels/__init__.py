"""A sparse voxel grid of density and spherical-harmonic colour, trained directly."""
