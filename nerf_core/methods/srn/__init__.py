"""Scene Representation Networks of a single scene: a learned ray marcher finds one point, and its features a colour."""
