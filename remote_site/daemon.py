"""The remote site's command, as `farhand remote` and as `python -m remote_site`."""

import typer

from remote_site.site import build_remote_site
from site_runtime.daemon import (
    Connect,
    DaemonOptions,
    Duration,
    Listen,
    Quiet,
    SessionPath,
    run_daemon,
)
from site_runtime.keys import SiteId


def remote(
    session: SessionPath,
    connect: Connect = None,
    listen: Listen = None,
    duration: Duration = None,
    quiet: Quiet = False,
) -> None:
    """Run the remote site until Ctrl-C."""
    options = DaemonOptions(
        None if connect is None else tuple(connect),
        None if listen is None else tuple(listen),
        duration,
        quiet,
    )
    raise typer.Exit(run_daemon(SiteId.REMOTE, build_remote_site, session, options))
