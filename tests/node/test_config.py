from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from node.config import FILE_MAX_BYTES, Config, Library, Server, load_config
from protocol.errors import ConfigError


def written(folder: Path, text: str) -> Path:
    path = folder / "node.toml"
    path.write_text(text)
    return path


def test_without_a_file_every_setting_has_its_default() -> None:
    assert load_config() == Config()


def test_the_defaults_lie_within_their_own_bounds() -> None:
    assert msgspec.convert(msgspec.to_builtins(Config()), Config) == Config()


def test_a_file_sets_what_it_names_and_leaves_the_rest(tmp_path: Path) -> None:
    path = written(tmp_path, '[capture]\nscanner = "/dev/ttyACM0"\nbaud = 115200\n[first_view]\nmax_bytes = 2048\n')
    config = load_config(path)
    assert (config.capture.scanner, config.capture.baud, config.first_view.max_bytes) == ("/dev/ttyACM0", 115200, 2048)
    assert (config.capture.stale_s, config.server) == (2.0, Server())


def test_overrides_win_over_the_file_and_none_means_not_given(tmp_path: Path) -> None:
    path = written(tmp_path, '[server]\nlisten = "127.0.0.1:1"\n[library]\nfolder = "/scans"\n')
    config = load_config(path, {"server.listen": "127.0.0.1:2", "library.folder": None, "capture.scanner": None})
    assert (config.server.listen, config.library.folder, config.capture.scanner) == ("127.0.0.1:2", "/scans", None)


def test_an_override_mends_a_file_that_would_be_refused_without_it(tmp_path: Path) -> None:
    path = written(tmp_path, '[server]\nlisten = "0.0.0.0:7345"\ninsecure = true\n')
    assert load_config(path, {"server.listen": "127.0.0.1:0"}).server.host == "127.0.0.1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[capture]\nbaud = 1", "capture.baud: expected int >= 9600"),
        ("[capture]\nbaud = 99999999999", "capture.baud: expected int <= 12000000"),
        ('[capture]\nbaud = "3000000"', "capture.baud: expected int, got str"),
        ("[capture]\nbaud = 1e6", "capture.baud: expected int, got float"),
        ("[capture]\nbaud = true", "capture.baud: expected int, got bool"),
        ("[capture]\nstale_s = nan", "capture.stale_s: expected float >= 0.1"),
        ("[capture]\nstale_s = inf", "capture.stale_s: expected float <= 60.0"),
        ("[capture]\npasses = 0", "capture.passes: expected int >= 1"),
        ("[capture]\noverlap = 256", "capture.overlap: expected int <= 255"),
        ("[capture]\nstride = 0", "capture.stride: expected int >= 1"),
        ('[capture]\nscanner = ""', "capture.scanner: expected str of length >= 1"),
        (
            "[capture]\nbauds = 1",
            "capture.bauds: unknown key; known here: scanner, baud, stale_s, passes, overlap, stride, apart, repair",
        ),
        ("[cap]\nbaud = 1", f"cap: unknown key; known here: {', '.join(Config.__struct_fields__)}"),
        ("capture = 3", "capture: expected a table, got int"),
        ("[planner]\ncold_start_bytes_s = 0", "planner.cold_start_bytes_s: expected float >= 1000.0"),
        ('[server]\ninsecure = "yes"', "server.insecure: expected bool, got str"),
        ('[server]\nlisten = "7345"', "server.listen: expected HOST:PORT or [IPv6]:PORT, got '7345'"),
        ('[server]\nlisten = "a:65536"', "server.listen: expected HOST:PORT or [IPv6]:PORT, got 'a:65536'"),
        ('[server]\nlisten = "::1:80"', "server.listen: expected HOST:PORT or [IPv6]:PORT, got '::1:80'"),
        (f'[discovery]\nname = "{"ä" * 32}"', "discovery.name: expected at most 63 bytes of UTF-8, got 64"),
    ],
)
def test_a_bad_setting_is_refused_by_file_and_place(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as refusal:
        load_config(path)
    assert str(refusal.value) == f"{path}: {message}"


def test_a_bad_override_is_refused_like_a_bad_file() -> None:
    with pytest.raises(ConfigError, match=r"^capture\.baud: expected int >= 9600$"):
        load_config(None, {"capture.baud": 300})
    with pytest.raises(ConfigError, match=r"^capture\.speed: unknown key"):
        load_config(None, {"capture.speed": 300})


def test_an_override_leaves_a_wrong_section_for_the_refusal(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="toml: capture: expected a table, got int$"):
        load_config(written(tmp_path, "capture = 3"), {"capture.baud": 9600})


@pytest.mark.parametrize("listen", ["0.0.0.0:7345", "192.168.1.7:0", "[::]:80", "scanner.local:80"])
def test_without_login_only_loopback_is_served(listen: str) -> None:
    with pytest.raises(ConfigError, match=r"^server\.insecure: "):
        load_config(None, {"server.insecure": True, "server.listen": listen})
    assert load_config(None, {"server.listen": listen}).server.listen == listen


def test_who_may_keep_scans_is_named() -> None:
    with pytest.raises(ConfigError, match=r"^server\.shared_cache: .*trusted_proxies"):
        load_config(None, {"server.shared_cache": True})
    assert load_config(None, {"server.shared_cache": True, "server.insecure": True}).server.shared_cache
    mine = {"server.shared_cache": True, "server.trusted_proxies": ["127.0.0.1", "fd00::1"]}
    assert load_config(None, mine).server.trusted_proxies == ("127.0.0.1", "fd00::1")
    with pytest.raises(ConfigError, match=r"^server\.trusted_proxies: expected an IP address, got 'proxy'"):
        load_config(None, {"server.trusted_proxies": ["proxy"]})


@pytest.mark.parametrize(
    ("listen", "host", "port"),
    [("127.0.0.1:0", "127.0.0.1", 0), ("[::1]:7345", "::1", 7345), ("localhost:65535", "localhost", 65535)],
)
def test_listen_splits_into_host_and_port(listen: str, host: str, port: int) -> None:
    server = load_config(None, {"server.insecure": True, "server.listen": listen}).server
    assert (server.host, server.port) == (host, port)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[capture", "not TOML"),
        (b'name = "\xff"', "not TOML"),
        (b"a = " + b"[" * 20000, "not TOML"),
        (b"#" * (FILE_MAX_BYTES + 1), "longer than"),
    ],
)
def test_a_file_that_is_no_configuration_is_refused_by_name(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "node.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as refusal:
        load_config(path)
    assert str(refusal.value).startswith(f"{path}: {message}")


def test_a_missing_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="none.toml: No such file or directory$"):
        load_config(tmp_path / "none.toml")


def test_sections_are_frozen() -> None:
    with pytest.raises(AttributeError):
        load_config().capture.baud = 1  # type: ignore[misc]


def test_the_library_folder_expands_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert Library(folder="~/scans").path == tmp_path / "scans"
    assert Library(folder="/srv/scans").path == Path("/srv/scans")


def test_an_unknown_home_is_a_config_error() -> None:
    with pytest.raises(ConfigError, match=r"^library\.folder: .*absolute path$"):
        _ = Library(folder="~nobody-of-this-name/scans").path


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=5,
)
sections = st.sampled_from(Config.__struct_fields__) | st.text(max_size=8)
keys = st.sampled_from(["baud", "listen", "folder", "window", "name", "max_bytes", "insecure"]) | st.text(max_size=8)


@given(st.dictionaries(st.tuples(sections, keys).map(".".join), values, max_size=4))
def test_any_settings_are_either_valid_or_a_config_error(overrides: dict[str, object]) -> None:
    try:
        config = load_config(None, overrides)
    except ConfigError:
        return
    assert msgspec.convert(msgspec.to_builtins(config), Config) == config
