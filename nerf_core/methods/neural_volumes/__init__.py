"""Neural Volumes, static scene: a decoder draws a volume of colour and opacity, and a warp lends it resolution.

Lombardi et al. 2019 (arXiv:1906.07751). The paper's encoder turns photos of a moment into a latent code. Here nothing
moves, so the code itself is learnt. Behind it, as in the paper, transposed convolutions decode a template, an inverse
warp moves each point of space into it, and opacity along a ray is added up until it reaches 1. Left out are the colour
decoder that knows the view, and the published code's affine warp of the whole volume. The weights of loss and priors
are this program's: colours are in [0, 1] here.
"""
