"""Samples along rays and the pixels that they composite to."""
