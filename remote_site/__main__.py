"""`python -m remote_site SESSION.toml`."""

import typer

from remote_site.daemon import remote

if __name__ == "__main__":
    typer.run(remote)
