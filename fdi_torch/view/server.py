"""The server of the viewer's pages, reachable from this machine only. The only importer of starlette and uvicorn.

Web pages of other origins cannot read the answers: a foreign `Host` is refused (so that a name cannot be rebound to
this address), and no answer allows another origin.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fdi_torch.jobs.report import page_of, report_of_log
from fdi_torch.logbook import read_run
from fdi_torch.report.material import gather
from fdi_torch.report.page import POLICY
from fdi_torch.tables import needed
from fdi_torch.view.log_list import RUNNING, UNSHOWN, LogList, selected
from fdi_torch.view.pages import NAVIGATION, address, follow_page, list_page, problem_page, query_of

HOST = "127.0.0.1"
HOSTS = (HOST, "localhost")
MOST_COMPARED = 20
HEADERS = {
    "Content-Security-Policy": f"{POLICY}; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Pages:
    """Answers to requests. One request is answered at a time, since pictures cannot be drawn in parallel."""

    def __init__(self, folder: Path) -> None:
        self.logs = LogList(folder)
        self._lock = threading.Lock()
        self._responses = needed("starlette.responses", "view")

    def listed(self, request: Any) -> Any:
        query = query_of(dict(request.query_params))
        with self._lock:
            entries = self.logs.entries()
        kinds = sorted({entry.kind for entry in entries} - {""})
        shown = selected(entries, query.text, query.kind, query.sort, query.down)
        return self._page(list_page(str(self.logs.folder), shown, kinds, query, len(entries)))

    def report(self, request: Any) -> Any:
        """The report of one log, or of several with their comparison."""
        names = list(dict.fromkeys(request.query_params.getlist("log")))
        if not 0 < len(names) <= MOST_COMPARED:
            return self._problem(f"Expected 1 to {MOST_COMPARED} logs, got {len(names)}; tick them in the list.", 400)
        paths = {name: self.logs.path(name) for name in names}
        missing = next((name for name, path in paths.items() if path is None), None)
        if missing is not None:
            return self._problem(f"Expected a log below {self.logs.folder}, got none at {missing}.", 404)
        try:
            with self._lock:
                reports = [report_of_log(path, []) for path in paths.values() if path is not None]
                return self._page(page_of(reports, [NAVIGATION]))
        except UNSHOWN as error:
            return self._problem(f"This log cannot be shown: {error}", 422)

    def follow(self, request: Any) -> Any:
        """A running job; a job that has ended is redirected to its report."""
        name = request.query_params.get("log", "")
        path = self.logs.path(name)
        with self._lock:
            entry = None if path is None else self.logs.entry(path.relative_to(self.logs.folder).as_posix(), path)
        if entry is None:
            return self._problem(f"Expected a log below {self.logs.folder}, got none at {name}.", 404)
        if entry.state != RUNNING:
            return self._responses.RedirectResponse(address("/report", log=entry.name), 303, HEADERS)
        try:
            material = gather(read_run(entry.path, salvage=True))
        except OSError:  # nothing can be read yet
            material = None
        return self._page(follow_page(entry, material))

    def _page(self, text: str, status: int = 200) -> Any:
        return self._responses.HTMLResponse(text.encode("utf-8", "replace"), status, HEADERS)

    def _problem(self, sentence: str, status: int) -> Any:
        return self._page(problem_page(sentence), status)


def application(folder: Path) -> Any:
    """The ASGI application: GET requests for the list, reports and running jobs, from this machine's names only."""
    pages = Pages(folder)
    route = needed("starlette.routing", "view").Route
    middleware = needed("starlette.middleware", "view").Middleware
    trusted = needed("starlette.middleware.trustedhost", "view").TrustedHostMiddleware
    routes = [route("/", pages.listed), route("/report", pages.report), route("/follow", pages.follow)]
    guards = [middleware(trusted, allowed_hosts=list(HOSTS), www_redirect=False)]
    return needed("starlette.applications", "view").Starlette(routes=routes, middleware=guards)


@contextmanager
def bound(folder: Path, port: int = 0) -> Iterator[tuple[str, Callable[[], None]]]:
    """The address of the pages, and the function that serves them until Ctrl-C. port 0: any free port.

    Raises ValueError if the folder or the extra `view` is missing, or the port is not available.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: folder not found; name another folder")
    uvicorn = needed("uvicorn", "view")
    # Without access log, WebSockets and lifespan events, none of which these pages have.
    config = uvicorn.Config(
        application(folder), log_level="error", access_log=False, ws="none", lifespan="off", server_header=False
    )
    with socket.socket() as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((HOST, port))
            listening.listen()  # requests that come before `serve` wait
        except (OSError, OverflowError) as error:
            raise ValueError(f"--port: expected a free port, got {port} ({error}); name another, or none") from None
        server = uvicorn.Server(config)
        yield f"http://{HOST}:{listening.getsockname()[1]}/", lambda: server.run(sockets=[listening])
