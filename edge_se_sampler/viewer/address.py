"""Where the viewer listens. Free of torch and viser."""

from __future__ import annotations

import errno
import os
import socket
import sys
from dataclasses import dataclass
from importlib.util import find_spec

from edge_se_sampler.data.scene_file import quote
from edge_se_sampler.errors import InputError, check_value


@dataclass(frozen=True)
class ViewerConfig:
    """The viewer's address."""

    host: str = "127.0.0.1"
    """Address to listen on: this machine alone can reach the default one, the whole network 0.0.0.0."""
    port: int = 7007
    """Port to listen on; 0 takes a free one."""

    def check(self) -> None:
        """InputError if the viewer cannot listen here; a line on stderr if others than this machine will reach it."""
        check_viser()
        check_value("port", self.port, 0 <= self.port < 2**16, "between 0 and 65535")
        try:
            family, _, _, _, address = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)[0]
            socket.create_server(address, family=family).close()
        except UnicodeError:
            raise InputError(f"--host {quote(self.host)}: is no name or address; give this machine's") from None
        except OSError as problem:
            if problem.errno == errno.EADDRINUSE:
                raise self.taken() from None
            reason = problem.strerror if isinstance(problem, socket.gaierror) else os.strerror(problem.errno or 0)
            address = f"{self.host}, port {self.port}"
            raise InputError(f"the viewer cannot listen on {address} ({reason}); choose others") from None
        if self.host not in ("127.0.0.1", "localhost", "::1"):
            print(f"edge-se: whoever reaches {self.host} can look at this run: there is no password", file=sys.stderr)

    def taken(self) -> InputError:
        return InputError(f"port {self.port} of {self.host} is taken; choose another, or 0 for a free one")


def check_viser() -> None:
    """InputError if viser is not installed."""
    if find_spec("viser") is None:
        raise InputError("the viewer needs the [view] extra: pip install 'edge-se-sampler[view]'")
