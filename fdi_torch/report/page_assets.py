"""The page's stylesheet and its only script: uPlot and the charts made with it.

The content security policy allows the script by its hash.
"""

from __future__ import annotations

import base64
import hashlib
from importlib.resources import files

_ASSETS = files("fdi_torch.report") / "assets"


def _text(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


LICENCE = _text("uPlot.LICENSE.txt")
_OWN = f'(() => {{\n"use strict";\n{_text("charts.js")}\n{_text("page.js")}}})();\n'
SCRIPT = "\n".join((f"/*\n{LICENCE}*/", _text("uPlot.iife.min.js"), _OWN))
STYLESHEET = _text("uPlot.min.css") + _text("page.css")

# Even if something passed the escaping, the browser would load nothing, and run nothing but SCRIPT.
_HASH = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
POLICY = f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{_HASH}'"
