"""A TraCI connection to a running SUMO: traci's calls, with the values of every step subscribed.

A call over the socket costs a hundred times as much as one of libsumo. So values of all vehicles, signals and
the simulation are subscribed. AV values are subscribed per vehicle, after its first query. Commands to
vehicles are queued and sent in one message with the next call that needs an answer.
"""

import contextlib
import io
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

from traci import constants as tc
from traci.connection import Connection
from traci.exceptions import FatalTraCIError, TraCIException
from traci.storage import Storage

from cosim.errors import BadInput, SimulationEnded, SimulationError

RETRY = 0.2  # s between attempts to connect
CONTEXT_RADIUS = 1e6  # m around a junction: the whole net

# Getters of libsumo and traci -> SUMO's variable (https://sumo.dlr.de/docs/TraCI), by subscription.
VEHICLES = {
    "getPosition": tc.VAR_POSITION,
    "getAngle": tc.VAR_ANGLE,
    "getSpeed": tc.VAR_SPEED,
    "getAcceleration": tc.VAR_ACCELERATION,
    "getLanePosition": tc.VAR_LANEPOSITION,
    "getTimeLoss": tc.VAR_TIMELOSS,
    "getCO2Emission": tc.VAR_CO2EMISSION,
    "getLaneID": tc.VAR_LANE_ID,  # the last one: it has no fixed size
}
AVS = {
    "getAllowedSpeed": tc.VAR_ALLOWED_SPEED,
    "getSpeedWithoutTraCI": tc.VAR_SPEED_WITHOUT_TRACI,
    "getLateralLanePosition": tc.VAR_LANEPOSITION_LAT,
    "getDistance": tc.VAR_DISTANCE,
    "getRoadID": tc.VAR_ROAD_ID,
    "getRouteIndex": tc.VAR_ROUTE_INDEX,
}
# Queried for all AVs at once when one AV is queried: variable, format and all values of its parameters.
ON_DEMAND: Mapping[str, tuple[int, str, Sequence[tuple[float, ...]]]] = {
    "getLaneChangeState": (tc.CMD_CHANGELANE, "i", ((1,), (-1,))),
    "getNextLinks": (tc.VAR_NEXT_LINKS, "", ((),)),
    "getFollower": (tc.VAR_FOLLOWER, "d", ((60.0,),)),
}
LIGHTS = {
    "getRedYellowGreenState": tc.TL_RED_YELLOW_GREEN_STATE,
    "getNextSwitch": tc.TL_NEXT_SWITCH,
}
SIMULATION = {
    "getTime": tc.VAR_TIME,
    "getDepartedIDList": tc.VAR_DEPARTED_VEHICLES_IDS,
    "getArrivedIDList": tc.VAR_ARRIVED_VEHICLES_IDS,
    "getStartingTeleportIDList": tc.VAR_TELEPORT_STARTING_VEHICLES_IDS,
    "getEndingTeleportIDList": tc.VAR_TELEPORT_ENDING_VEHICLES_IDS,
    "getCollidingVehiclesNumber": tc.VAR_COLLIDING_VEHICLES_NUMBER,
    "getEmergencyStoppingVehiclesIDList": tc.VAR_EMERGENCYSTOPPING_VEHICLES_IDS,
    "getStopStartingVehiclesIDList": tc.VAR_STOP_STARTING_VEHICLES_IDS,
    "getStopEndingVehiclesIDList": tc.VAR_STOP_ENDING_VEHICLES_IDS,
    "getPendingVehicles": tc.VAR_PENDING_VEHICLES,
}
# The message of one vehicle: per variable its id, a status of 0, the type and the value.
_NUMBERS = len(VEHICLES) - 2  # without position and lane
_ROW, _SIZE = struct.Struct(f"!3s2d{_NUMBERS * '3sd'}3si"), struct.Struct("!i")
_TYPES = (tc.POSITION_2D, *[tc.TYPE_DOUBLE] * _NUMBERS, tc.TYPE_STRING)
_HEADS = tuple(bytes((variable, 0, kind)) for variable, kind in zip(VEHICLES.values(), _TYPES, strict=True))
Row = tuple[Any, ...]  # values in the order of `VEHICLES`
# Commands that change no subscribed value before the next step; after any other, values are queried again.
LAZY_COMMANDS = {"setSpeed", "setTau", "setMinGap", "setSpeedMode", "setLaneChangeMode", "changeLaneRelative"}


class Client:
    """One of several clients of a running SUMO; an interface for `cosim.simulation.backend`.

    Args:
        host, port: SUMO's address; tried for `timeout` s.
        order: unique rank among the clients; a higher rank acts later and wins a conflict.
        timeout: s that SUMO may take to answer, including its wait for the other clients.

    Raises BadInput if no SUMO listens there. Any call raises SimulationEnded when the connection is lost.
    """

    TraCIException, FatalTraCIError, constants = TraCIException, FatalTraCIError, tc

    def __init__(self, host: str, port: int, order: int, timeout: float) -> None:
        self.place = f"{host}:{port}"
        self._connection = _connect(host, port, timeout)
        try:
            self._connection.setOrder(order)
            self.version: str = self._connection.getVersion()[1]
        except (TraCIException, FatalTraCIError, SimulationEnded) as error:
            raise SimulationError(f"{self.place}: {error}") from None
        c = self._connection
        self.edge, self.junction, self.lane, self.person = c.edge, c.junction, c.lane, c.person
        self.vehicletype, self.polygon = c.vehicletype, c.polygon
        c.simulation.subscribe(list(SIMULATION.values()))
        for light in c.trafficlight.getIDList():
            c.trafficlight.subscribe(light, list(LIGHTS.values()))
        self.simulation, self.trafficlight = (
            _Domain(c.simulation, SIMULATION),
            _Domain(c.trafficlight, LIGHTS),
        )
        self.vehicle = _Vehicles(c)

    def simulationStep(self) -> None:
        """Send the commands, wait for the other clients, drive one step."""
        self._connection.flush()
        with contextlib.redirect_stdout(io.StringIO()):  # traci prints missing values of removed vehicles
            self._connection.simulationStep()
        if not self.simulation.results:  # the subscriptions are gone
            raise SimulationEnded("its owner has loaded another simulation")
        here, results = self.vehicle.stepped(), self.simulation.results[""]
        departed = results[tc.VAR_DEPARTED_VEHICLES_IDS]
        results[tc.VAR_DEPARTED_VEHICLES_IDS] = tuple(name for name in departed if name in here)

    def close(self) -> None:
        """Disconnect; SUMO continues with its other clients."""
        for last in (self._connection.flush, self.vehicle.unsubscribe, self._connection.close):
            with contextlib.suppress(TraCIException, FatalTraCIError, SimulationEnded):
                last()


class _Connection(Connection):  # type: ignore[misc]  # traci is not typed
    """traci's connection with a timeout for every answer; commands to vehicles wait for `flush`."""

    _socket: Any
    _queue: list[int]
    _string: bytes

    def __init__(self, host: str, port: int, timeout: float) -> None:
        self._waits = self._gathers = False
        self.vehicle_rows: dict[str, Row] = {}  # vehicle -> values of the last step
        super().__init__(host, port, None, None, False)
        self._timeout = timeout
        self._socket.settimeout(timeout)

    def flush(self) -> None:
        """Send the queued commands; those to vehicles removed by another client are ignored."""
        if self._queue:
            try:
                self._sendExact()
            except TraCIException as error:
                if "is not known" not in str(error):
                    raise

    def ask(self, command: int, variable: int, form: str, asked: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Call one getter for many objects in one message. `asked`: object and parameters, in `form`."""
        self.flush()
        self._gathers = True
        try:
            for name, *parameters in asked:
                self._sendCmd(command, variable, name, form, *parameters)
        finally:
            self._gathers = False
        message, self._string, self._queue = self._string, b"", []
        try:
            self._socket.sendall(struct.pack("!i", len(message) + 4) + message)
        except OSError:
            self._lose("SUMO has gone")
        answer, values = self._recvExact(), []
        for _ in asked:
            _, _, failed = answer.read("!BBB")
            words = answer.readString()
            if failed:
                raise TraCIException(words)
            answer.readLength()
            answer.read("!BB")
            answer.readString()
            values.append(self._subscriptionMapping[command].parse(variable, answer))
        return values

    def _sendCmd(self, cmdID: int, *words: Any) -> Any:
        self._waits = self._gathers or cmdID == tc.CMD_SET_VEHICLE_VARIABLE
        if not self._waits:
            self.flush()
        try:
            return super()._sendCmd(cmdID, *words)
        finally:
            self._waits = False

    def _readSubscription(self, result: Any) -> Any:
        """As traci, with a reader for vehicle rows that is many times faster."""
        begin = result._pos
        result.readLength()
        if result.read("!B")[0] == tc.RESPONSE_SUBSCRIBE_JUNCTION_CONTEXT:
            junction = result.readString()
            domain, variables, count = result.read("!BBi")
            if domain == tc.CMD_GET_VEHICLE_VARIABLE and variables == len(VEHICLES):
                with contextlib.suppress(struct.error):
                    self.vehicle_rows, result._pos = _rows(result._content, result._pos, count)
                    return junction, tc.RESPONSE_SUBSCRIBE_JUNCTION_CONTEXT
        result._pos = begin
        return super()._readSubscription(result)

    def _sendExact(self) -> Any:
        if self._waits:
            return None
        try:
            return super()._sendExact()
        except OSError:
            self._lose("SUMO has gone")

    def _recvExact(self) -> Any:
        try:
            size = int.from_bytes(self._read(4), "big") - 4
            return Storage(self._read(size))
        except TimeoutError:
            self._lose(f"no answer for {self._timeout:g} s: SUMO waits for all of its clients")
        except OSError:
            self._lose("SUMO has gone")
        except BaseException:  # interrupted: the next read would get this answer
            self._drop()
            raise

    def _read(self, size: int) -> bytes:
        whole = bytearray()
        while len(whole) < size:
            part = self._socket.recv(min(size - len(whole), 1 << 20))
            if not part:
                raise ConnectionError
            whole += part
        return bytes(whole)

    def _lose(self, why: str) -> NoReturn:
        self._drop()
        raise SimulationEnded(why) from None

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket, self._queue, self._string = None, [], b""


def _connect(host: str, port: int, timeout: float) -> _Connection:
    until = time.monotonic() + timeout
    while True:
        try:
            return _Connection(host, port, timeout)
        except ConnectionRefusedError:
            if time.monotonic() > until:
                raise BadInput(
                    f"no SUMO listens there (tried for {timeout:g} s); a running SUMO accepts no further "
                    "clients: at its start it waits for --num-clients",
                    value=f"{host}:{port}",
                ) from None
            time.sleep(RETRY)
        except OSError as error:
            raise BadInput(f"cannot connect: {error.strerror or error}", value=f"{host}:{port}") from None


def _rows(content: bytes, at: int, count: int) -> tuple[dict[str, Row], int]:
    """`VEHICLES` of `count` vehicles from byte `at`, and the end byte. Raises struct.error for other data."""
    found: dict[str, Row] = {}
    for _ in range(count):
        end = at + 4 + _SIZE.unpack_from(content, at)[0]
        name = content[at + 4 : end].decode()
        first, x, y, *others, last, size = _ROW.unpack_from(content, end)
        if (first, *others[::2], last) != _HEADS:
            raise struct.error
        at = end + _ROW.size + size
        found[name] = (x, y), *others[1::2], content[at - size : at].decode()
    return found, at


class _Domain:
    """One of traci's domains, whose getters answer from the subscription results of the last step."""

    def __init__(self, domain: Any, subscribed: Mapping[str, int]) -> None:
        self._domain = domain
        self.results: dict[str, dict[int, Any]] = domain.getAllSubscriptionResults()  # updated in place
        for name, variable in subscribed.items():
            setattr(self, name, self._getter(name, variable))

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._domain, name)
        setattr(self, name, found)
        return found

    def _getter(self, name: str, variable: int) -> Callable[..., Any]:
        return lambda of="": self.results[of][variable]


class _Vehicles(_Domain):
    """The vehicle domain; `AVS` are subscribed for a vehicle at its first query."""

    def __init__(self, connection: _Connection) -> None:
        super().__init__(connection.vehicle, AVS)
        self._connection, self._junctions = connection, connection.junction
        self._junction: str = self._junctions.getIDList()[0]
        self._junctions.subscribeContext(
            self._junction, tc.CMD_GET_VEHICLE_VARIABLE, CONTEXT_RADIUS, list(VEHICLES.values())
        )
        self._ids: tuple[str, ...] | None = None
        self._avs: set[str] = set()  # vehicles with subscribed `AVS`
        self._cached: dict[tuple[Any, ...], Any] = {}  # (variable, AV, parameters) -> value of this step
        for column, name in enumerate(VEHICLES):
            setattr(self, name, self._row_getter(name, column))
        for name, (variable, form, parameters) in ON_DEMAND.items():
            setattr(self, name, self._common_getter(variable, form, parameters))

    def stepped(self) -> set[str]:
        """Call after a step: the vehicles on the road; other clients may have removed some."""
        self._ids = self._domain.getIDList()
        here = set(self._ids)
        self._cached.clear()
        for vehicle in self._connection.vehicle_rows.keys() - here:
            del self._connection.vehicle_rows[vehicle]
            self.results.pop(vehicle, None)
        return here

    def unsubscribe(self) -> None:
        """End the subscription: SUMO would otherwise go on computing it for the other clients."""
        self._junctions.unsubscribeContext(self._junction, tc.CMD_GET_VEHICLE_VARIABLE, CONTEXT_RADIUS)

    def getIDList(self) -> tuple[str, ...]:
        """All vehicles on the road."""
        if self._ids is None:
            self._ids = tuple(self._domain.getIDList())
        return self._ids

    def __getattr__(self, name: str) -> Any:
        call = getattr(self._domain, name)
        if name.startswith(("set", "remove")) and name not in LAZY_COMMANDS:

            def found(vehicle: str, *values: Any) -> None:
                if name == "remove" and vehicle in self._avs:  # else every client gets an error message
                    self._domain.unsubscribe(vehicle)
                call(vehicle, *values)
                self._connection.vehicle_rows.pop(vehicle, None)
                self.results.pop(vehicle, None)
                self._ids = None

        else:
            found = call
        setattr(self, name, found)
        return found

    def _common_getter(
        self, variable: int, form: str, every: Sequence[tuple[float, ...]]
    ) -> Callable[..., Any]:
        def get(vehicle: str, *parameters: float) -> Any:
            key = (variable, vehicle, *parameters)
            if key not in self._cached:
                avs = {vehicle, *(self._avs & set(self.getIDList()))}
                asked = [(one, *values) for one in avs for values in every]
                found = self._connection.ask(tc.CMD_GET_VEHICLE_VARIABLE, variable, form, asked)
                self._cached.update(((variable, *one), v) for one, v in zip(asked, found, strict=True))
            return self._cached[key]

        return get

    def _row_getter(self, name: str, column: int) -> Callable[[str], Any]:
        ask, connection = getattr(self._domain, name), self._connection

        def get(vehicle: str) -> Any:
            try:
                return connection.vehicle_rows[vehicle][column]
            except KeyError:
                return ask(vehicle)

        return get

    def _getter(self, name: str, variable: int) -> Callable[..., Any]:
        ask = getattr(self._domain, name)

        def get(vehicle: str) -> Any:
            try:
                return self.results[vehicle][variable]
            except KeyError:
                if vehicle in self._avs:  # a command changed the vehicle since the last step
                    return ask(vehicle)
                self._domain.subscribe(vehicle, list(AVS.values()))
                self._avs.add(vehicle)
                return self.results[vehicle][variable]

        return get
