"""Where a CARLA server listens, and whether it answers."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

from ssad.core.errors import ConfigError, install_extra

if TYPE_CHECKING:
    import carla

T = TypeVar("T")
VERSION: Final = "0.9.16"
PORT: Final = 2000
_ADDRESS = re.compile(
    r"^carla://(?P<host>[A-Za-z0-9_.\-]+|\[[0-9A-Fa-f:]+\])(:(?P<port>\d{1,5}))?/?(\?(?P<more>[A-Za-z=&]*))?$"
)
WEATHERS: Final = (
    *(
        f"{kind}{hour}"
        for hour in ("Noon", "Sunset", "Night")
        for kind in ("Clear", "Cloudy", "Wet", "WetCloudy", "SoftRain", "HardRain")
    ),
    "MidRainyNoon",
    "MidRainSunset",
    "MidRainyNight",
    "DustStorm",
)
"""Presets of `carla.WeatherParameters`."""
_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "sensors": ("mirror", "carla"),
    "traffic": ("autopilot", "manager"),
    "weather": WEATHERS,
}


@dataclass(frozen=True)
class Server:
    """Where a CARLA server listens.

    Attributes:
        host: Name or address.
        port: Its first port.
        timeout: s that it may take for an answer; a map may take five times as long.
        weather: Of `WEATHERS`.
        sensors: Whose cameras and LiDARs drivers look through: SSAD's in the `mirror`, or `carla`'s own.
        traffic: Who drives the background traffic: SSAD's `autopilot`, or CARLA's Traffic `manager`.
    """

    host: str
    port: int = PORT
    timeout: float = 20.0
    weather: str = "ClearNoon"
    sensors: str = "mirror"
    traffic: str = "autopilot"

    @staticmethod
    def of(address: str) -> Server:
        """The server of an address such as carla://HOST:PORT?sensors=carla&traffic=manager&weather=HardRainNoon.

        Raises:
            ConfigError: It is none.
        """
        found = _ADDRESS.match(address)
        port = int(found["port"] or PORT) if found else 0
        if found is None or not 0 < port < 65535:
            raise ConfigError(f"simulator '{address}': expected carla://HOST or carla://HOST:PORT")
        told = [part.partition("=")[::2] for part in (found["more"] or "").split("&") if part]
        for name, value in told:
            if value not in _CHOICES.get(name, ()):
                known = "; ".join(f"{key}={' or '.join(values)}" for key, values in _CHOICES.items())
                raise ConfigError(f"simulator '{address}': there is no {name}={value}; there are {known}")
        return Server(found["host"].strip("[]"), port, **dict(told))

    def __str__(self) -> str:
        return f"CARLA at {self.host}:{self.port}"


def connect(server: Server) -> carla.Client:
    """A client of a server that answers and is of the client's version.

    Raises:
        ConfigError: The package is missing, nobody answers, or the versions differ.
    """
    try:
        import carla
    except ImportError as error:
        raise ConfigError(f"carla is not installed ({error}); {install_extra('carla')}") from None
    client = carla.Client(server.host, server.port)
    client.set_timeout(server.timeout)
    there = asked(server, "connect", client.get_server_version)
    here = client.get_client_version()
    if there != here:
        raise ConfigError(f"{server}: the server is version {there}, the package carla {here}; both must be {VERSION}")
    return client


def asked(server: Server, doing: str, call: Callable[[], T]) -> T:
    """What a call gives; a ConfigError of one line where the server does not answer, or refuses."""
    try:
        return call()
    except RuntimeError as error:
        why = " ".join(str(error).split())[:200]
        raise ConfigError(f"{server}: cannot {doing}: {why}; is the server running, and is it still?") from None


def probe(server: Server) -> None:
    """Ask a server for its version, in a process of its own: the package's C++ may abort where it meets another server.

    Raises:
        ConfigError: It does not answer, is of another version, or the package is missing or dies.
    """
    code = "import sys; from ssad.simulators.carla.server import main; main(*sys.argv[1:])"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code, server.host, str(server.port)],
            capture_output=True,
            text=True,
            check=False,
            timeout=3.0 * server.timeout,
        )
    except subprocess.TimeoutExpired:
        raise ConfigError(f"{server}: no answer in {3.0 * server.timeout:g} s") from None
    if done.returncode == 2:
        raise ConfigError(done.stdout.strip())
    if done.returncode != 0:
        raise ConfigError(f"{server}: the package carla ended with code {done.returncode} while it asked for a version")


def main(host: str, port: str) -> None:
    """What `probe` runs: exit code 2 and a line where `connect` fails."""
    try:
        connect(Server(host, int(port)))
    except ConfigError as error:
        print(error)
        raise SystemExit(2) from None
