"""The operator's side: its controller, its operators, `python -m local_site`."""
