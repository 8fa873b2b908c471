"""Fields: (x, d) → density and colour."""
