"""The paper: arrays in, arrays out, no clock, no I/O, no device. One block a file, cited."""
