"""What the web server refuses."""

import pytest

from ctm_plugin.view.guard import admitted

HERE = "127.0.0.1:8080"
TOKEN = "secret"


@pytest.mark.parametrize(
    ("origin", "host", "answered"),
    [
        (None, HERE, True),
        (None, "LOCALHOST", True),
        (None, "[::1]", True),
        ("http://127.0.0.1:8080", HERE, True),
        ("https://[::1]:8080", "[::1]:8080", True),
        # Other sites.
        ("http://elsewhere.example", HERE, False),
        ("http://127.0.0.1:9090", HERE, False),
        ("null", HERE, False),
        ("http://127.0.0.1:8080@elsewhere.example", HERE, False),
        # DNS rebinding: to the browser a page of that name comes from this server.
        ("http://elsewhere.example:8080", "elsewhere.example:8080", False),
        (None, "127.0.0.1.elsewhere.example", False),
        (None, "localhost.example", False),
        (None, "10.0.0.7", False),
        (None, "", False),
    ],
)
def test_pages_of_other_sites(origin, host, answered):
    headers = {"Host": host} | ({"Origin": origin} if origin else {})
    assert admitted("/", headers, None) == answered


@pytest.mark.parametrize(
    ("path", "cookies", "answered"),
    [
        ("/?token=secret", "", True),
        ("/", "other=1; ctm_view=secret", True),
        ("/", "", False),
        ("/?token=", "", False),
        ("/?token=secre", "", False),
        ("/?token=secret2", "ctm_view=guess", False),
        ("/?tok=secret", "ctm_view=", False),
        ("/secret", "other=secret; my_ctm_view=secret", False),
        ("/?token=s%C3%A9cret", "ctm_view=s\xe9cret", False),
    ],
)
def test_other_machines_need_the_token(path, cookies, answered):
    assert admitted(path, {"Host": "there:8080", "Cookie": cookies}, TOKEN) == answered
