"""Neural Volumes, static scene: a decoder draws a volume of colour and opacity, and a warp lends it resolution.

Lombardi et al. 2019 (arXiv:1906.07751). The paper's encoder turns photos of a moment into a latent code. Here nothing
moves, so the code itself is learnt. Everything behind it is the paper's: transposed convolutions decode a template, an
inverse warp moves each point of space into it, and opacity along a ray is added up until it reaches 1.
"""
