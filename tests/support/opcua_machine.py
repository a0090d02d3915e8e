"""An OPC UA server that drives a simulated machine: `python opcua_machine.py OPTIONS` with OPTIONS as JSON.

plant: a machine's TOML; url; speed; ring: samples; block: samples; user, password; certificate, private_key.
It prints "ready URL" when it listens.
"""

import asyncio
import gc
import json
import os
import sys
import time
from typing import Any

import numpy as np
from asyncua import Server, ua
from asyncua.crypto.permission_rules import User, UserRole

from servotwin.control.gains import gains_of, settable
from servotwin.cosim.machine import compile_ahead
from servotwin.drives.opcua import model
from servotwin.drives.simulated.plants import SupervisedPlant
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.errors import InvalidInput

STARTS = {
    "Rate": (0.0, ua.VariantType.Double),
    "Block": (0, ua.VariantType.UInt32),
    "Machine": ("", ua.VariantType.String),
    "Count": (0, ua.VariantType.UInt64),
    "Version": (0, ua.VariantType.Int64),
    "Since": (0, ua.VariantType.UInt64),
    "NewVersion": (0, ua.VariantType.Int64),
    "SetGains": (False, ua.VariantType.Boolean),
    "IntegralOnly": (False, ua.VariantType.Boolean),
    "Commit": (0, ua.VariantType.UInt32),
    "Committed": (0, ua.VariantType.UInt32),
    "Refused": ("", ua.VariantType.String),
}


class Users:
    """One user, if any."""

    def __init__(self, options: dict[str, Any]) -> None:
        self._known = options.get("user"), options.get("password")

    def get_user(self, _server: Any, username: Any = None, password: Any = None, certificate: Any = None) -> Any:
        del certificate
        return User(role=UserRole.User) if (username, password) == self._known else None


class Machine:
    """The variables and the plant behind them."""

    def __init__(self, options: dict[str, Any]) -> None:
        self.options = options
        settings = MachineSettings.load(options["plant"])
        compile_ahead(settings.scenario)  # before it says that it is ready: a client waits for a second
        self.plant, self.law = SupervisedPlant(settings), settings.scenario.law
        fields = settable(type(self.law))
        self.gains = {model.variable(name): name for name in (fields if options.get("optional", True) else fields[:4])}
        self.rings = np.zeros((4, options.get("ring", 4000)))
        self.variables: dict[str, Any] = {}
        self.rate = settings.rate
        self.committed = 0

    async def offer(self, server: Server) -> None:
        place = await server.register_namespace(model.NAMESPACE)
        drive = await server.nodes.objects.add_object(place, self.options.get("node", model.OBJECT))
        for name in (*model.EVERY, *self.gains):
            value, kind = STARTS.get(name, (0.0, ua.VariantType.Double))
            start = self.rings[0].tolist() if name in model.SIGNALS else value
            self.variables[name] = await drive.add_variable(place, name, start, kind)
            if name in (*model.PARAMETERS, model.COMMIT, *self.gains):
                await self.variables[name].set_writable()
        await self.set("Rate", self.rate)
        await self.set("Block", self.plant.block)
        await self.set("Machine", os.urandom(4).hex())

    async def set(self, name: str, value: Any) -> None:
        await self.variables[name].write_value(value, STARTS.get(name, (0.0, ua.VariantType.Double))[1])

    async def step(self) -> None:
        await self.decide()
        first = self.plant.index
        self.plant.advance(self.plant.block)
        found = self.plant.read(first, self.plant.block)
        assert found is not None
        self.rings[:, np.arange(first, self.plant.index) % self.rings.shape[1]] = found.values
        for name, ring in zip(model.SIGNALS, self.rings, strict=True):
            await self.set(name, ring.tolist())
        await self.set("Count", self.plant.index)

    async def decide(self) -> None:
        commit = await self.variables["Commit"].read_value()
        if commit == self.committed:
            return
        self.committed = commit
        version, tolerance, with_gains = [await self.variables[name].read_value() for name in model.PARAMETERS]
        gains = {name: await self.variables[each].read_value() for each, name in self.gains.items()}
        refused = ""
        try:
            kind = type(gains_of(self.law))
            self.plant.write(version, tolerance, kind(**gains) if with_gains else None)
        except (InvalidInput, ValueError) as error:
            refused = str(error)
        else:
            await self.set("Since", self.plant.index)
            await self.set("Version", version)
        await self.set("Refused", refused)
        await self.set("Committed", commit)

    async def run(self, speed: float) -> None:
        start, begin = time.monotonic(), self.plant.index
        while True:
            due = start + (self.plant.index - begin) / (self.rate * speed)
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            if time.monotonic() - due > 0.5:  # stopped for a while: that time is given up
                start, begin = time.monotonic(), self.plant.index
            await self.step()


async def serve(options: dict[str, Any]) -> None:
    server = Server(user_manager=Users(options) if "user" in options else None)
    gc.disable()  # searching the standard's thousands of nodes for garbage would take as long as making them
    await server.init()
    gc.enable()
    server.set_endpoint(options["url"])
    if "certificate" in options:
        await server.load_certificate(options["certificate"])
        await server.load_private_key(options["private_key"])
        server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
    if "user" in options:
        server.set_identity_tokens([ua.UserNameIdentityToken])
    machine = Machine(options)
    await machine.offer(server)
    async with server:
        print("ready", options["url"], flush=True)
        await machine.run(options.get("speed", 1.0))


if __name__ == "__main__":
    asyncio.run(serve(json.loads(sys.argv[1])))
