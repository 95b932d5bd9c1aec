"""The viewer of a folder of logs, as an HTTP client on this machine meets it."""

from __future__ import annotations

import http.client
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import quote, urlsplit

import numpy as np
import pytest

from fdi_torch.cli import MISUSE, main
from fdi_torch.cli.view import _fitting
from fdi_torch.logbook import RunLog, read_run
from fdi_torch.report.material import gather
from fdi_torch.report.predictions import residual_size
from fdi_torch.view.log_list import LogList, selected

DATA = Path(__file__).parents[1] / "data"
NASTY = '<script>alert("1")</script>'


class Page(HTMLParser):
    """Links, ticked values, tags and words of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.boxes: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.tags.append((tag, values))
        if tag == "a":
            self.links.append(values["href"] or "")
        if tag == "input" and values["type"] == "checkbox":
            self.boxes.append(values["value"] or "")

    def handle_data(self, data: str) -> None:
        self.words += data + "\n"


class Client:
    """Requests to a server, each on a connection of its own."""

    def __init__(self, address: str) -> None:
        self.host, self.port = urlsplit(address).hostname or "", urlsplit(address).port or 0

    def ask(self, path: str, method: str = "GET", **headers: str) -> tuple[int, str, http.client.HTTPMessage]:
        connection = http.client.HTTPConnection(self.host, self.port, timeout=60)
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, text, answer.headers

    def page(self, path: str) -> Page:
        status, text, _ = self.ask(path)
        assert status == 200, text
        return Page(text)


def write_fit(path: Path, error: float, name: str = "T1.leak.size") -> Path:
    """A fit whose residuals alternate between + and - `error`, m."""
    time = np.arange(10.0)
    model = np.full((10, 2), 0.3)
    read = model + error * np.where(np.arange(10) % 2, 1.0, -1.0)[:, None]
    with RunLog(path, "train", config_text="plant: three_tank\n") as log:
        log.recording(time, np.full((10, 1), 4e-5), read, ("Q1",), ("h1", "h2"), ("m^3/s",), ("m", "m"))
        location, _, effect = name.partition(".")
        log.fault(effect, location, True, size=0.3, size_std=0.01, unit="1")
        log.result_arrays(predicted=model)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    (folder / "may").mkdir()
    write_fit(folder / "coarse.mcap", 0.02)
    write_fit(folder / "may/fine.mcap", 0.0005)
    write_fit(folder / f"{quote(NASTY, safe='<>()')}.mcap".replace("/", "_"), 0.005, name=f"T1.{NASTY}")
    (folder / "gap.mcap").write_bytes((DATA / "log_format_1_gap.mcap").read_bytes())
    (folder / "broken.mcap").write_bytes(b"not a log")
    (folder.parent / "secret.mcap").write_bytes((DATA / "log_format_1_train.mcap").read_bytes())
    return folder


@pytest.fixture(scope="module")
def client(folder: Path) -> Iterator[Client]:
    words = [sys.executable, "-m", "fdi_torch", "view", str(folder)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None and server.stderr is not None
            address = re.search(r"http://\S+/", server.stdout.readline())
            assert address is not None
            yield Client(address[0])
            server.send_signal(signal.SIGINT)
            said = server.communicate(timeout=30)[1]
            assert server.returncode == 0 and "Traceback" not in said and "ended" in said
        finally:
            server.kill()


def test_a_server_is_ended_by_kill_as_by_ctrl_c(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "fdi_torch", "view", str(tmp_path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None and server.stdout.readline()
        server.terminate()
        said = server.communicate(timeout=30)[1]
    assert server.returncode == 0 and said.endswith("ended\n") and "the same command" not in said


def test_only_this_machine_is_served_and_under_its_own_name_only(client: Client) -> None:
    assert client.host == "127.0.0.1"
    for host, status in {
        f"localhost:{client.port}": 200,
        "evil.example": 400,
        f"evil.example:{client.port}": 400,
    }.items():
        assert client.ask("/", Host=host)[0] == status
    status, text, _ = client.ask("/report?log=gap.mcap", Host="127.0.0.1.evil.example")
    assert status == 400 and "gap" not in text


def test_every_answer_forbids_scripts_frames_and_other_origins(client: Client) -> None:
    for path in ("/", "/report?log=gap.mcap", "/report?log=none.mcap", "/report"):
        status, _, headers = client.ask(path, Origin="http://evil.example")
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "form-action 'self'" in policy
        assert "unsafe-inline" not in policy.replace("style-src 'unsafe-inline'", "")
        assert headers["X-Content-Type-Options"] == "nosniff" and headers["Access-Control-Allow-Origin"] is None
        assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert (status == 200) == (path in ("/", "/report?log=gap.mcap"))


def test_nothing_can_be_changed_and_nothing_outside_the_folder_be_read(client: Client, folder: Path) -> None:
    assert client.ask("/", "POST")[0] == 405 and client.ask("/report?log=gap.mcap", "DELETE")[0] == 405
    for name in ("../secret.mcap", str(folder.parent / "secret.mcap"), "%2e%2e/secret.mcap", "may/../../secret.mcap"):
        status, text, _ = client.ask(f"/report?log={name}")
        assert status == 404 and "Fault" not in text
    assert client.ask("/secret.mcap")[0] == 404


def test_the_list_has_every_log_with_its_verdict_and_error(client: Client) -> None:
    page = client.page("/")
    assert set(page.boxes) > {"coarse.mcap", "may/fine.mcap", "gap.mcap"} and "broken.mcap" not in page.boxes
    assert "Single fault: leak at T1" in page.words and "expected an MCAP file" in page.words
    assert "\n2 cm\n" in page.words or "\n2.00 cm\n" in page.words


def test_the_list_is_filtered_and_sorted_by_links(client: Client) -> None:
    def names(path: str) -> list[str]:
        return [name for name in client.page(path).boxes if "alert" not in name]

    assert names("/?sort=error&order=down") == ["coarse.mcap", "gap.mcap", "may/fine.mcap"]
    assert names("/?sort=error&order=up") == ["may/fine.mcap", "gap.mcap", "coarse.mcap"]
    assert names("/?q=MAY+leak") == ["may/fine.mcap"] and names("/?q=nowhere") == []
    assert names(f"/?kind={quote('Sim-to-real gap')}") == ["gap.mcap"]
    sorting = [link for link in client.page("/?q=leak&sort=error&order=down").links if "sort=error" in link]
    assert sorting == ["/?q=leak&kind=&sort=error&order=up"]
    assert set(names("/?sort=__class__&order=sideways")) == set(names("/"))


def test_a_click_on_a_log_shows_its_report_and_leads_back(client: Client) -> None:
    link = next(link for link in client.page("/").links if "fine" in link)
    page = client.page(link)
    assert "Fault diagnosis · fine" in page.words and "/" in page.links
    assert any(tag == "svg" for tag, _ in page.tags)


def test_ticked_logs_are_compared(client: Client) -> None:
    page = client.page("/report?log=coarse.mcap&log=may%2Ffine.mcap&log=coarse.mcap")
    assert "Comparison" in page.words and page.words.count("Fault diagnosis ·") == 2


def test_names_from_logs_stay_text(client: Client) -> None:
    name = next(name for name in client.page("/").boxes if "alert" in name)
    for path in (
        "/",
        f"/?q={quote(NASTY)}&kind={quote(NASTY)}",
        f"/report?log={quote(name)}",
        f"/report?log={quote(NASTY)}",
    ):
        _, text, _ = client.ask(path)
        assert "<script>alert" not in text and "alert" in text


def test_a_running_job_is_followed_until_its_report(client: Client, folder: Path) -> None:
    path = folder / "live.mcap"
    with RunLog(path, "train", config={"estimate": {"search": {"evaluations": 200}}}) as log:
        topic = "/estimator/de/generation"
        log.write(topic, {"problem": 0, "generation": 3, "best_cost": 0.25, "evaluations": 50}, 3)
        log.say("halfway there")
        log.flush()
        listed = client.page("/")
        link = next(link for link in listed.links if "live.mcap.partial" in link)
        assert link.startswith("/follow?") and "running" in listed.words
        page = client.page(link)
        assert "search: generation 3, cost 0.25, 50 of at most 200 simulations" in page.words
        assert ("progress", {"value": "0.250", "max": "1"}) in page.tags and "halfway there" in page.words
        assert any(values.get("http-equiv") == "refresh" for tag, values in page.tags if tag == "meta")
        log.write(topic, {"problem": 0, "generation": 4, "best_cost": 0.2, "evaluations": 100}, 4)
        log.flush()
        assert "generation 4" in client.page(link).words
    status, _, headers = client.ask(link)
    assert (status, headers["Location"]) == (303, "/report?log=live.mcap")
    assert "Fault diagnosis · live" in client.page(headers["Location"]).words


def test_a_killed_job_is_not_shown_as_running(client: Client, folder: Path) -> None:
    whole = (DATA / "log_format_1_train.mcap").read_bytes()
    (folder / "killed.mcap.partial").write_bytes(whole[: len(whole) // 2])
    logs = LogList(folder)
    entry = logs.entry("killed.mcap.partial", folder / "killed.mcap.partial")
    assert entry is not None and entry.state == "did not end"
    assert client.ask("/follow?log=killed.mcap.partial")[0] == 303


def test_a_changed_log_is_read_again(tmp_path: Path) -> None:
    logs, path = LogList(tmp_path), write_fit(tmp_path / "a.mcap", 0.02)
    (before,) = logs.entries()
    assert logs.entries()[0] is before
    path.unlink()
    write_fit(path, 0.01)
    (after,) = logs.entries()
    assert (round(before.error, 6), round(after.error, 6)) == (0.02, 0.01)


def test_logs_without_an_error_come_last_in_both_directions(tmp_path: Path) -> None:
    (tmp_path / "none.mcap").write_bytes((DATA / "log_format_1_study.mcap").read_bytes())
    write_fit(tmp_path / "a.mcap", 0.01)
    entries = LogList(tmp_path).entries()
    for down in (True, False):
        assert [entry.name for entry in selected(entries, sort="error", down=down)] == ["a.mcap", "none.mcap"]


def test_the_error_is_the_root_mean_square_of_the_residuals(tmp_path: Path) -> None:
    size, unit, _ = residual_size(gather(read_run(write_fit(tmp_path / "a.mcap", 0.02))))
    assert size == pytest.approx(0.02, rel=1e-12) and unit == "m"
    log = read_run(DATA / "log_format_1_monitor.mcap")
    columns = [[m.payload[name] for m in log.messages(["/observer/residual"])] for name in ("h1", "h2", "h3")]
    assert residual_size(gather(log))[0] == pytest.approx(float(np.sqrt(np.nanmean(np.square(columns)))), rel=1e-12)


def test_what_cannot_be_served_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path / "none")]) == MISUSE
    assert "folder not found" in capsys.readouterr().err
    assert main(["view", str(tmp_path), "--port", "70000"]) == MISUSE
    assert "--port: expected a free port, got 70000" in capsys.readouterr().err


def test_a_verdict_is_cut_to_the_width_of_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    header, rows = ("log", "verdict"), [["a.mcap", "leak " * 40], ["longer.mcap", "none"]]
    piped = _fitting(header, rows)
    assert len(piped[0][1]) == 100 and piped[0][1].endswith("…") and piped[1] == rows[1]
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    first, second = _fitting(header, rows)
    assert len(first[1]) == 80 - len("longer.mcap") - 2 and first[1].endswith("…") and second == rows[1]


def test_the_list_is_printed_for_a_day_and_for_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_fit(tmp_path / "a.mcap", 0.02)
    started = read_run(tmp_path / "a.mcap").metadata["fdi_torch.run"]["started"][:10]
    assert main(["view", str(tmp_path), "--list", started]) == 0
    assert "a.mcap" in capsys.readouterr().out
    assert main(["view", str(tmp_path), "--list", "train"]) == 0
    assert "a.mcap" in capsys.readouterr().out
    assert main(["view", str(tmp_path), "--list", "no such words"]) == 0
    assert capsys.readouterr().out == "no log matches 'no such words'\n"
    assert main(["view", str(tmp_path / "gone"), "--list"]) != 0
