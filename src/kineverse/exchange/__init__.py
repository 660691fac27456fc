"""Models shared by processes: a server keeps them, clients edit and follow them (layer 6)."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .address import list_servers as list_servers
    from .client import LiveModel as LiveModel
    from .connection import Connection as Connection
    from .relay import Relay as Relay
    from .server import Server as Server, serve as serve
    from .state import Newest as Newest, StatePublisher as StatePublisher, StateReader as StateReader

lazy_face(__name__)
