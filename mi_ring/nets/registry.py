"""Registers classes of networks by name. The file `ring.pt` stores these names instead of pickled classes."""

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

from torch import nn

from mi_ring.errors import InputError

GROUP = "mi_ring.networks"  #: entry points by which other packages offer networks

_networks: dict[str, type[nn.Module]] = {}


def register_network(name: str) -> Callable[[type[nn.Module]], type[nn.Module]]:
    """Return a decorator that registers a class of networks under `name`. The file `ring.pt` stores this name.

    The class may have a method `arguments`. It returns the arguments of the constructor as a dict of plain data, which
    `ring.pt` stores together with the weights (`state_dict`). Another package may offer a network as an entry point of
    the group `mi_ring.networks`; the user then need not import the package. The decorator raises ValueError if another
    class has this name.
    """

    def register(network: type[nn.Module]) -> type[nn.Module]:
        known = _networks.get(name)
        if known is not None and qualified_name(known) != qualified_name(network):
            raise ValueError(f"network {name}: is registered already, as {known.__module__}.{known.__qualname__}")
        _networks[name] = network
        return network

    return register


def qualified_name(network: type) -> tuple[str, str]:
    """Return (module, name) of a class. Both stay the same if a notebook cell defines the class again."""
    return network.__module__, network.__qualname__


def is_registered(network: nn.Module) -> bool:
    """Return True if the class of a network is registered, so that a file can hold the network."""
    return any(qualified_name(type(network)) == qualified_name(known) for known in _networks.values())


def architecture_of(network: nn.Module) -> dict:
    """Describe a network as plain data: a dict with its registered "name" and its constructor's "arguments", a dict.

    Raises ValueError if the class of the network is not registered.
    """
    for name, known in _networks.items():
        if qualified_name(type(network)) == qualified_name(known):
            arguments = getattr(network, "arguments", None)
            return {"name": name, "arguments": arguments() if arguments else {}}
    raise ValueError(f'{type(network).__name__}: is not registered, so it cannot be saved; put '
                     '@mi_ring.register_network("…") above the class')  # fmt: skip


def build(architecture: dict) -> Any:
    """Make a network with random weights from its description, {"name": registered name, "arguments": dict}.

    The arguments are those of the constructor. Raises InputError if the name is not registered.
    """
    name = architecture["name"]
    for entry in entry_points(group=GROUP, name=name) if name not in _networks else ():
        register_network(name)(entry.load())
    if name not in _networks:
        raise InputError(f'networks: was fitted with "{name}", which is not registered here (known: '
                         f"{', '.join(sorted(_networks))}); import the module that registers it first")  # fmt: skip
    return _networks[name](**architecture["arguments"])
