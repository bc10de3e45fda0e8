"""What leaves a site for people: rows, stream, result files, dashboard."""
