"""Session files and studies."""
