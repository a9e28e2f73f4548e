"""What the web server refuses."""

import pytest

from ctm_plugin.view.guard import allowed


@pytest.mark.parametrize(
    ("path", "origin", "host"),
    [
        ("/", None, "127.0.0.1:8080"),
        ("/assets/index.js?x=1", None, ""),
        ("/", "http://127.0.0.1:8080", "127.0.0.1:8080"),
        ("/", "http://localhost:8080", "localhost:8080"),
        ("/", "https://[::1]:8080", "[::1]:8080"),
    ],
)
def test_allowed(path, origin, host):
    assert allowed(path, origin, host)


@pytest.mark.parametrize(
    ("path", "origin", "host"),
    [
        ("/../secret", None, ""),
        ("/assets/../../secret", None, ""),
        ("/..", None, ""),
        ("/..\\secret", None, ""),
        ("/C:\\secret", None, ""),
        ("//etc/passwd", None, ""),
        ("etc/passwd", None, ""),
        ("http://elsewhere/", None, ""),
        ("/", "http://elsewhere.example", "127.0.0.1:8080"),
        ("/", "http://127.0.0.1:9090", "127.0.0.1:8080"),
        ("/", "null", "127.0.0.1:8080"),
        ("/", "http://127.0.0.1:8080@elsewhere.example", "127.0.0.1:8080"),
    ],
)
def test_refused(path, origin, host):
    assert not allowed(path, origin, host)
