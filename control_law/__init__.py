"""The paper: arrays in, arrays out. No clock, no I/O, no device; one block a file, equations cited."""
