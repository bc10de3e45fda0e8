"""The far side: its controller, its environments, `python -m remote_site`."""
