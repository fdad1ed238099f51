"""Who may use the viewer: those who know the token in its address, under a name of this machine."""

import http.client
import socket
import threading
import time
from contextlib import closing
from urllib.parse import urlsplit

import pytest
from browser import open_page
from export_scenes import moving_scene
from view_client import Client, at_work
from websockets.exceptions import InvalidStatus
from websockets.sync.server import serve

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.view.access_control import access_control
from endoprior.view.addresses import check_address, is_known_host, is_open, names_of_machine
from endoprior.view.incoming import RateLimit
from endoprior.view.panel import IMAGE
from endoprior.view.server import Viewer
from endoprior.view.viewable_scene import ViewableScene

HOSTS = ("127.0.0.1", "127.0.0.2", "127.1", "LOCALHOST", "localhost", "0.0.0.0", "::1", "0:0:0:0:0:0:0:1", "::")
STRANGE = ("evil.example", "127.0.0.1.evil.example", "localhost.evil.example", "", "[", "a b", "[::1")


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    """A viewer of a small scene, at work."""
    with at_work(Viewer(ViewableScene(moving_scene(), "wall"), out=tmp_path_factory.mktemp("run") / "view")) as viewer:
        yield viewer


def ask(url: str, path: str | None = None, host: str | None = None) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of the answer to a request of `path`, under the name `host`."""
    parts = urlsplit(url)
    with closing(http.client.HTTPConnection(parts.hostname, parts.port, timeout=10)) as connection:
        connection.request("GET", path or parts.path, headers={} if host is None else {"Host": host})
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()


def test_only_the_address_with_the_token_shows_the_page(viewer):
    path = urlsplit(viewer.url).path
    assert len(path) > 30
    wrong = ["/", "/?token=1", "/index.html", path[:-2], path + "x", path.upper(), path + "index.html", "//", "/%00"]
    for asked in (*wrong, "/?websocket=ws://evil.example/", f"/?token={path.strip('/')}"):
        status, headers, body = ask(viewer.url, asked)
        assert status == 403 and len(body.splitlines()) == 1 and b"the address that endoprior printed" in body, asked
        assert path.strip("/") not in str(headers)
    status, headers, body = ask(viewer.url)
    assert status == 200 and b"<script" in body and headers["Referrer-Policy"] == "no-referrer"
    assert headers["X-Content-Type-Options"] == "nosniff"
    policy = headers["Content-Security-Policy"].split("; ")
    assert {"default-src 'none'", "connect-src 'self' data:", "frame-ancestors 'none'"} <= set(policy)


@pytest.mark.parametrize("query", ("?websocket=ws://evil.example/", "?", "?playbackPath=x", "?a?b"))
def test_queries_are_redirected_away(viewer, query):
    path = urlsplit(viewer.url).path
    status, headers, _ = ask(viewer.url, path + query)
    assert status == 302 and headers["Location"] == path
    assert ask(viewer.url, path.removesuffix("/"))[1]["Location"] == path


def test_sockets_need_the_token_and_a_name_of_this_machine(viewer):
    for url in (f"http://127.0.0.1:{viewer.port}", viewer.url[:-3]):
        with pytest.raises(InvalidStatus, match="403"):
            Client(url)
    with pytest.raises(InvalidStatus, match="403"):
        rebound = socket.create_connection(("127.0.0.1", viewer.port))
        Client(viewer.url.replace("127.0.0.1", "evil.example"), sock=rebound)
    client = Client(viewer.url)
    client.send_camera()
    assert client.image(quiet=0.1).any()
    client.socket.close()


@pytest.mark.parametrize("bound", HOSTS)
def test_every_spelling_of_an_address_has_the_same_rules(bound):
    own = ("127.0.0.1:8080", "127.0.0.1", "localhost:1", "LocalHost", "[::1]:80", "192.0.2.7:80", socket.gethostname())
    assert all(is_known_host(name, bound) for name in (*own, f"[{bound}]" if ":" in bound else f"{bound}:8080"))
    assert not any(is_known_host(name, bound) for name in STRANGE)
    try:
        check_address(bound, 0)
    except InputError:
        pytest.skip(f"{bound} is no address of this machine")
    viewer = Viewer(ViewableScene(moving_scene(), "wall"), host=bound)
    try:
        assert ask(viewer.url)[0] == 200 and ask(viewer.url, "/")[0] == 403
        assert ask(viewer.url, host=f"evil.example:{viewer.port}")[0] == 403
    finally:
        viewer.close()


def test_names_of_this_machine_are_known(monkeypatch):
    names_of_machine.cache_clear()
    monkeypatch.setattr(socket, "gethostname", lambda: "Box")
    monkeypatch.setattr(socket, "getfqdn", lambda: "box.lab.example")
    monkeypatch.setattr(socket, "gethostbyaddr", lambda _name: ("box.lab.example", ["gpu.lab.example"], []))
    for name in ("box", "BOX.lab.example:80", "box.lab.example.", "gpu.lab.example", "box.local:8080"):
        assert is_known_host(name, "0.0.0.0"), name
    for name in (*STRANGE, "lab.example", "box.evil.example", "xbox.lab.example", "box.lab.example.evil.example"):
        assert not is_known_host(name, "0.0.0.0"), name
    names_of_machine.cache_clear()


def test_the_full_name_of_this_machine_shows_the_page(viewer):
    assert ask(viewer.url, host=f"{socket.getfqdn()}:{viewer.port}")[0] == 200


def test_names_that_the_user_allows_are_known(tmp_path):
    viewer = Viewer(ViewableScene(moving_scene(), "wall"), names=("viewer.lab.example", "Other.example"))
    try:
        assert ask(viewer.url, host="evil.example")[0] == 403
        for name in ("viewer.lab.example", "VIEWER.lab.example.", "other.example:443"):
            assert ask(viewer.url, host=name)[0] == 200 and ask(viewer.url, "/", host=name)[0] == 403
        status, _, body = ask(viewer.url, host="sub.viewer.lab.example")
        assert status == 403 and b"`endoprior view RUN --allow-host NAME`" in body
    finally:
        viewer.close()


@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("https://viewer.example/x", "viewer.example"), ("viewer.example:80", "viewer.example"), ("*", "NAME"),
        ("*.lab.example", "NAME"), ("a b", "NAME"), ("höst", "NAME"), ("-x", "NAME"), ("[::1", "NAME"),
    ],
)  # fmt: skip
def test_what_is_no_name_of_a_host_is_not_allowed(name, fix, tmp_path, capsys):
    assert main(["view", str(tmp_path), f"--allow-host={name}"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("endoprior: --allow-host: expected the name of a host, such as viewer.example.org, got ")
    assert said.endswith(f"Fix: `--allow-host {fix}`.\n")


def test_the_name_given_as_host_is_known():
    assert is_known_host("server.example:8080", "Server.example") and not is_known_host("server.example", "127.0.0.1")


def test_open_addresses_are_told_from_those_of_this_machine():
    assert [is_open(host) for host in ("127.0.0.1", "127.0.0.2", "LOCALHOST", "::1")] == [False] * 4
    assert is_open("0.0.0.0") and is_open("::") and is_open("192.0.2.7")


def test_an_occupied_address_is_an_error():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match="--port 0"):
            check_address("127.0.0.1", taken.getsockname()[1])
    with pytest.raises(InputError, match="--port"):
        check_address("127.0.0.1", 70000)
    for host in ("192.0.2.7", "no such host", "x" * 300):
        with pytest.raises(InputError, match="Correct --host"):
            check_address(host, 0)
    check_address("127.0.0.1", 0)


def test_no_viewer_starts_unguarded():
    with pytest.raises(RuntimeError, match="access control"), access_control("token", "127.0.0.1", lambda *_: True):
        pass  # a viser that starts its web server in another way


def test_a_rate_is_counted_in_each_second():
    rate = RateLimit(2)
    times = (0.0, 0.1, 0.2, 0.9, 1.0, 1.5, 1.9)
    assert [now for now in times if rate.exceeded(now)] == [0.2, 0.9, 1.9]


def test_at_most_one_file_of_a_kind_is_written_in_a_second(viewer):
    client = Client(viewer.url)
    client.send_camera()
    client.image(quiet=0.1)
    began = time.monotonic()
    while time.monotonic() - began < 1.5:
        client.set(viewer.panel.save_view, IMAGE)
        time.sleep(0.005)
    time.sleep(0.3)
    written = len(list(viewer.out.iterdir()))
    assert 1 <= written <= time.monotonic() - began + 1
    client.socket.close()


@pytest.mark.slow
def test_a_page_of_another_site_cannot_take_over_the_viewer(viewer):
    """viser's page obeys `?websocket=`, and what the server there sends runs with the rights of the viewer's page."""
    visits = []

    def frame_the_viewer(connection, request):
        visits.append(request.path)
        page = connection.respond(200, f"<iframe src='{viewer.url}'></iframe>")
        del page.headers["Content-Type"]
        page.headers["Content-Type"] = "text/html"
        return None if "Upgrade" in request.headers else page

    with serve(lambda _: None, "127.0.0.1", 0, process_request=frame_the_viewer) as evil:
        thread = threading.Thread(target=evil.serve_forever)
        thread.start()
        place = f"127.0.0.1:{evil.socket.getsockname()[1]}"
        with open_page(f"http://127.0.0.1:{viewer.port}/?websocket=ws://{place}/") as page:
            assert "endoprior printed" in page.evaluate("document.body.innerText")
        with open_page(f"{viewer.url}?websocket=ws://{place}/") as page:  # even with the token
            page.wait_for("document.querySelector('[role=slider]') !== null")
            # A script in the page can send nothing away.
            connect = f"const s = new WebSocket('ws://{place}/script')"
            page.evaluate(f"new Promise(done => {{ {connect}; s.onopen = s.onerror = () => done() }})")
            page.evaluate(f"fetch('http://{place}/fetch', {{ mode: 'no-cors' }}).catch(() => 0)")
        assert visits == []
        with open_page(f"http://{place.replace('127.0.0.1', 'localhost')}/frame") as page:
            end = time.monotonic() + 6
            while time.monotonic() < end:
                assert not viewer.watched
                time.sleep(0.1)
        assert "/frame" in visits
        evil.shutdown()
        thread.join()
