"""The remote site's command, as `farhand remote` and as `python -m remote_site`."""

from remote_site.site import build_remote_site
from site_runtime.daemon import site_command
from site_runtime.keys import SiteId

remote = site_command(SiteId.REMOTE, build_remote_site)
