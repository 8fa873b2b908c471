"""Instant-ngp's hash grid with two small networks."""
