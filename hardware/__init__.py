"""The hardware-abstraction layer: device interface, robot model, simulated backend, driver registry."""
