"""The studies of `nerf-core lab` and of the Lab panel: one file each."""
