"""What the redundant robot does with the freedom the main task leaves: g = −∂f/∂q, Section V."""
