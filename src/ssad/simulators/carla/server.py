"""Address of a CARLA server, and the connection to it."""

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
    """Address and options of a CARLA server.

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
        """Parse an address such as carla://HOST:PORT?sensors=carla&traffic=manager&weather=HardRainNoon.

        Raises:
            ConfigError: The address or an option is invalid.
        """
        parsed = _ADDRESS.match(address)
        port = int(parsed["port"] or PORT) if parsed else 0
        if parsed is None or not 0 < port < 65535:
            raise ConfigError(f"simulator '{address}': expected carla://HOST or carla://HOST:PORT")
        options = [part.partition("=")[::2] for part in (parsed["more"] or "").split("&") if part]
        for name, value in options:
            if value not in _CHOICES.get(name, ()):
                choices = "; ".join(f"{key}={' or '.join(values)}" for key, values in _CHOICES.items())
                raise ConfigError(f"simulator '{address}': there is no {name}={value}; there are {choices}")
        return Server(parsed["host"].strip("[]"), port, **dict(options))

    def __str__(self) -> str:
        return f"CARLA at {self.host}:{self.port}"


def connect(server: Server) -> carla.Client:
    """Connect to a server that answers and has the client's version.

    Raises:
        ConfigError: The package is missing, the server does not answer, or the versions differ.
    """
    try:
        import carla
    except ImportError as error:
        raise ConfigError(f"carla is not installed ({error}); {install_extra('carla')}") from None
    client = carla.Client(server.host, server.port)
    client.set_timeout(server.timeout)
    server_version = call_server(server, "connect", client.get_server_version)
    client_version = client.get_client_version()
    if server_version != client_version:
        raise ConfigError(
            f"{server}: the server is version {server_version}, the package carla "
            f"{client_version}; both must be {VERSION}"
        )
    return client


def call_server(server: Server, action: str, request: Callable[[], T]) -> T:
    """Return the result of a request; ConfigError of one line where the server does not answer, or refuses."""
    try:
        return request()
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"{server}: cannot {action}: {reason}; is the server running, and is it still?") from None


def check_version(server: Server) -> None:
    """Ask a server for its version in a separate process: the C++ library may abort on another server.

    Raises:
        ConfigError: The server does not answer, has another version, or the package is missing or crashes.
    """
    code = "import sys; from ssad.simulators.carla.server import main; main(*sys.argv[1:])"
    try:
        process = subprocess.run(
            [sys.executable, "-c", code, server.host, str(server.port)],
            capture_output=True,
            text=True,
            check=False,
            timeout=3.0 * server.timeout,
        )
    except subprocess.TimeoutExpired:
        raise ConfigError(f"{server}: no answer in {3.0 * server.timeout:g} s") from None
    if process.returncode == 2:
        raise ConfigError(process.stdout.strip())
    if process.returncode != 0:
        raise ConfigError(
            f"{server}: the package carla ended with code {process.returncode} while it asked for a version"
        )


def main(host: str, port: str) -> None:
    """Run the check of `check_version`: exit code 2 and one line of output if `connect` fails."""
    try:
        connect(Server(host, int(port)))
    except ConfigError as error:
        print(error)
        raise SystemExit(2) from None
