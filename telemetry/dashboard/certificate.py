"""The certificate at a glance, in words and large numbers."""

from math import inf, isfinite
from typing import Final

import numpy as np
import rerun as rr

from telemetry.dashboard.canvas import Canvas
from telemetry.picture import Picture
from telemetry.rows import RowArray

EVERY_NS: Final = 250_000_000
SILENT_NS: Final = 500_000_000


class CertificatePanel:
    """Writes the panel four times a second, so that a viewer that comes late has it at once."""

    def __init__(self, canvas: Canvas, picture: Picture) -> None:
        self._canvas = canvas
        self._picture = picture
        self._written_ns: int | None = None

    def draw(self, until_ns: int, newest: tuple[tuple[int, RowArray] | None, ...]) -> None:
        """Write it from each site's newest row and its time [ns]; None before a site's first."""
        if self._written_ns is not None and until_ns - self._written_ns < EVERY_NS:
            return
        self._written_ns = until_ns
        rows = [
            None if item is None or until_ns - item[0] > SILENT_NS else item[1] for item in newest
        ]
        text = certificate_text(self._picture, rows[0], rows[1])
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._canvas.log("certificate", until_ns, document)


def certificate_text(picture: Picture, local: RowArray | None, remote: RowArray | None) -> str:
    """Return the panel in Markdown, from one row of each site; None of a site that is silent."""
    present = [row for row in (local, remote) if row is not None]
    lines = [_verdict(picture, present)]
    names = [view.name for view in picture.sites]
    told = [
        f"{name} **silent**" if row is None else f"{name} **{_state(picture, row)}**"
        for name, row in zip(names, (local, remote), strict=True)
    ]
    if local is not None and remote is not None:
        told.append(f"apart **{_apart_mm(local, remote):.0f} mm**{_aligned(picture, present)}")
    lines.append(" · ".join(told))
    return "\n\n".join(f"# {line}" for line in lines)


def _verdict(picture: Picture, rows: list[RowArray]) -> str:
    certified_s = min((float(row["certified_round_trip_s"]) for row in rows), default=inf)
    loops_s = [float(row["loop_bound_s"]) for row in rows]
    known_s = [loop_s for loop_s in loops_s if isfinite(loop_s)]
    theorem = "" if picture.certificate is None else f" ({picture.certificate.theorem})"
    if certified_s <= 0.0:
        return "**NOT CERTIFIED** for any round trip"
    limit = f"{certified_s * 1e3:.0f} ms{theorem}" if isfinite(certified_s) else ""
    if not known_s:
        return f"**NO LOOP** yet{limit and f' · certified up to {limit}'}"
    loop_s = max(known_s)
    if not limit:
        return f"loop **{loop_s * 1e3:.0f} ms**"
    margin_ms = (certified_s - loop_s) * 1e3
    verdict = "CERTIFIED" if margin_ms >= 0.0 else "BEYOND THE CERTIFICATE"
    return f"**{verdict}** margin **{margin_ms:+.0f} ms** · loop **{loop_s * 1e3:.0f}** of {limit}"


def _state(picture: Picture, row: RowArray) -> str:
    name = picture.state_names.get(int(row["state"]), f"state {int(row['state'])}")
    share = float(row["force_share"])
    # Of a site without outputs, a share says nothing.
    return f"{name} {share:.0%}" if share > 0.0 else name


def _apart_mm(local: RowArray, remote: RowArray) -> float:
    told_m = local["position_m"] - local["offset_m"]
    return float(np.linalg.norm(told_m - (remote["position_m"] - remote["offset_m"]))) * 1e3


def _aligned(picture: Picture, rows: list[RowArray]) -> str:
    certificate = picture.certificate
    if certificate is None or certificate.align_within_m is None:
        return ""
    aligning = any(_state(picture, row) == "ALIGNING" for row in rows)
    return f" (engages within {certificate.align_within_m * 1e3:.0f} mm)" if aligning else ""
