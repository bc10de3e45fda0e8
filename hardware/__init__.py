"""The hardware-abstraction layer: device interface, robot model, simulated arm, registry."""
