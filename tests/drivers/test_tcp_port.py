"""A port over TCP, against the listener of a simulated scanner."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from drivers.address import parse_tcp
from drivers.discover import config_for, open_port
from drivers.tcp_port import TcpPort
from protocol.errors import ConfigError, PortLost
from protocol.framing import USB_PAYLOAD_MAX
from simulators.tcp_carrier import TcpListener, parse_listen


@pytest.fixture
def far() -> Iterator[TcpListener]:
    with closing(TcpListener(("127.0.0.1", 0))) as listener:
        yield listener


def met(far: TcpListener) -> TcpPort:
    """A port whose connection the far end has taken."""
    port = TcpPort(far.name)
    assert far.read(10, 5) == b""
    return port


@pytest.mark.parametrize(
    ("address", "place"), [("tcp:localhost:7000", ("localhost", 7000)), ("tcp:[::1]:65535", ("::1", 65535))]
)
def test_an_address_names_host_and_port(address: str, place: tuple[str, int]) -> None:
    assert parse_tcp(address) == place


@pytest.mark.parametrize("address", ["tcp:", "tcp:host", "tcp:host:0", "tcp:host:65536", "tcp:::1:80", "tcp:a b:80"])
def test_an_address_that_makes_no_sense_is_refused_in_words(address: str) -> None:
    with pytest.raises(PortLost, match="is not tcp:HOST:PORT"):
        open_port(address)


@pytest.mark.parametrize(
    ("text", "place"), [("7000", ("127.0.0.1", 7000)), ("0.0.0.0:1", ("0.0.0.0", 1)), ("[::1]:0", ("::1", 0))]
)
def test_a_scanner_listens_to_this_machine_alone_unless_told_otherwise(text: str, place: tuple[str, int]) -> None:
    assert parse_listen(text) == place
    with pytest.raises(ConfigError, match="expected PORT or HOST:PORT"):
        parse_listen(text + "x")


def test_bytes_go_both_ways_in_frames_as_long_as_those_on_usb(far: TcpListener) -> None:
    with closing(met(far)) as port:
        port.write(b"ping")
        assert far.read(10, 5) == b"ping"
        far.write(b"pong")
        assert port.read(10, 5) == b"pong" and port.read(10, 0.01) == b""
    assert config_for(far.name).payload_max == USB_PAYLOAD_MAX


def test_cancel_ends_a_read(far: TcpListener) -> None:
    with closing(met(far)) as port:
        threading.Timer(0.05, port.cancel).start()
        began_s = time.monotonic()
        assert port.read(10, 30) == b"" and time.monotonic() - began_s < 10


def test_nobody_there_is_told_with_the_cure(far: TcpListener) -> None:
    far.hang_up()
    with pytest.raises(PortLost, match="cannot connect: Connection refused; is the scanner there"):
        TcpPort(far.name)


def test_a_far_end_that_hangs_up_is_lost_and_found_again(far: TcpListener) -> None:
    with closing(met(far)) as port:
        far.hang_up()
        for _ in range(2):
            with pytest.raises(PortLost, match="the other end hung up"):
                port.read(10, 5)
        with pytest.raises(PortLost):
            port.write(b"x")
    far.plug_in()
    met(far).close()


def test_a_second_node_is_sent_away_and_one_that_left_makes_room(far: TcpListener) -> None:
    with closing(met(far)) as first:
        with closing(met(far)) as second, pytest.raises(PortLost):
            second.read(10, 5)
        far.write(b"still here")
        assert first.read(10, 5) == b"still here"
    assert far.read(10, 5) == b""
    with closing(met(far)) as third:
        far.write(b"welcome")
        assert third.read(10, 5) == b"welcome"


def test_what_is_sent_to_nobody_goes_nowhere(far: TcpListener) -> None:
    far.write(b"hello?")
    with closing(met(far)) as port:
        assert port.read(10, 0.05) == b""


@pytest.mark.usefixtures("many_open_files")
def test_a_connection_made_late_by_a_node_with_many_clients_works() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        with closing(TcpPort(f"tcp:127.0.0.1:{listener.getsockname()[1]}")) as port, listener.accept()[0] as far:
            far.sendall(b"ping")
            assert port.read(10, 60) == b"ping"
            port.write(b"pong")
            assert far.recv(10) == b"pong"
