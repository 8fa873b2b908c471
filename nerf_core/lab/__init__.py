"""The lecture's studies: each trains and measures some rows one after the other, and writes a report of them."""
