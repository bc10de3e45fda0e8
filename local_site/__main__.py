"""`python -m local_site SESSION.toml`."""

import typer

from local_site.daemon import local

if __name__ == "__main__":
    typer.run(local)
