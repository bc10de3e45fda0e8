"""The command line, one module a command; wires everything, knows no mathematics."""
