"""Aircraft files: which surface is which, how it is calibrated, which servo turns it."""

from __future__ import annotations

import datetime
import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, Union, get_args, get_origin

from pydantic import Field, ValidationError, model_validator

from servofd.aircraft.axes import MotionModel
from servofd.aircraft.calibrated import CalibratedServo
from servofd.aircraft.calibration import Calibration, DegreeCalibration, Entry
from servofd.aircraft.current import CalibratedCurrent, CurrentSource
from servofd.core.errors import ConfigError, DesignError, ServofdError, UnknownName, suggest
from servofd.core.evidence import ModelOrigin
from servofd.core.tolerance import Tolerance
from servofd.core.toml_text import read_toml
from servofd.servo.catalogue import EffectTable, effects_installed
from servofd.servo.effects.linkage import PositionLimit
from servofd.servo.library import Positive, Servo, find_servo, library
from servofd.servo.physics import Physics
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


_Positive = Annotated[float, Field(gt=0.0, lt=1e5, strict=True)]
"""Type of a positive number of an aircraft file; larger ones are in a wrong unit."""
_Share = Annotated[float, Field(ge=0.0, lt=1.0, strict=True)]
"""Type of a share of an aircraft file."""


class Limits(Entry):
    """Limits of what `servofd trend` follows; what is left out follows from the surface's tolerances."""

    dead_band_deg: _Positive = 2.0
    """Full width of dead band or backlash. The thesis' threshold of 1.5 deg alarms at 3 deg (4.2.1); at 2 deg two
    thirds of it are used up."""
    bias_deg: _Positive | None = None
    """To either side; None: the constant threshold."""
    delay_s: _Positive | None = None
    """None: the model's, and five tolerances."""
    bandwidth_hz: _Positive | None = None
    """None: the model's, less three tolerances."""
    rate_limit_deg_s: _Positive | None = None
    """None: the model's, less three tolerances."""
    rate_per_volt_deg_s_v: _Positive | None = None
    """None: none."""
    noise_deg: _Positive | None = None
    """None: three tolerances."""
    residual_p95_deg: _Positive | None = None
    """None: the constant threshold."""
    margin: _Share = 0.0
    """Share of the threshold that must be left."""
    current_ratio: _Positive | None = None
    """Current of motion over that of good flights; None: three times what good flights differ by."""
    current_spread_a: _Positive | None = None
    """Of the current in motion; None: likewise, from four good flights on."""
    idle_current_a: _Positive | None = None
    """None: none."""


UNKNOWN_SERVO = "unknown"
"""Type of a servo that is not named: it is fitted to the log."""
DEFAULT_THRESHOLD_DEG = 1.5
"""Thesis 4.2: the residuals of healthy HS-225BB servos on FASER commands stay within +-1.5 deg."""

DEFAULT_SIGMAS = 6.0
"""Gaussian noise in a residual of the default filter's colour exceeds 6 standard deviations 7e-4 times an hour."""

Sigmas = Annotated[float, Field(ge=1.0, le=100.0, strict=True)]
"""How many standard deviations of noise a threshold leaves free."""


class Table(Entry):
    """How to read a CSV file that does not use servofd's own column names."""

    columns: tuple[str, ...] = ()
    """Names for a file without a header line, in order."""
    time: str = "time_s"
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    sample_rate_hz: Positive | None = None
    """For a file without a time column."""
    run: str = ""
    """Column that tells separate experiments apart; they are never joined."""
    where: dict[str, str] = {}
    """Keep only rows in which these columns hold these texts."""


class Swap(Entry):
    """A servo was replaced."""

    date: datetime.date
    """Flights that begin on this day (UTC) or later are flown with the new servo."""
    removed: str = ""
    """Serial number of the servo that was taken out."""


class Surface(Entry):
    """One control surface and the servo that turns it."""

    servo: str = UNKNOWN_SERVO
    command: Calibration
    measured: Calibration | None = None
    """None: the log tells where the position of `output` is; or, without an output, nothing measures this surface."""
    output: Annotated[int, Field(ge=1, le=32, strict=True)] | None = None
    """Output of the autopilot that turns it; logs of autopilots that lack the channels named here are read by it."""
    alive: tuple[str, ...] = ()
    """Channels of the same telemetry that change as long as it lives; rows in which nothing does say nothing."""
    load: str = ""
    """Channel of a force, torque or current that pushes the shaft from outside; left out, one that is named so."""
    command_saturation_deg: tuple[float, float] | None = None
    """Limits applied to the command after it is logged and before the servo sees it."""
    position_limit_deg: tuple[float, float] | None = None
    """Stops of the linkage."""
    effects: EffectTable = {}
    """What the servo's linear model lacks: effect to parameters, as ``servofd explain --save`` writes them."""
    command_hold: Literal["zoh", "linear"] = "zoh"
    """ "linear" for logs that hold fewer commands than the servo received."""
    command_period_s: Annotated[float, Field(gt=0.0, le=1.0, strict=True)] | None = None
    """Period at which the autopilot really updates the command; for "linear" alone."""
    threshold_deg: Positive = DEFAULT_THRESHOLD_DEG
    threshold: Literal["constant", "interval"] = "constant"
    """ "interval" follows the activity of the command, within `tolerance`."""
    threshold_sigmas: Sigmas = DEFAULT_SIGMAS
    """Standard deviations of noise in the interval threshold."""
    persistence: Annotated[int, Field(ge=1, le=100, strict=True)] = 1
    """Samples in a row, all on one side, that make an alarm."""
    tolerance: Tolerance | None = None
    """How far a healthy servo may differ from its model; None: as far as `threshold_deg` was made for."""
    suspicions: bool = True
    """Whether what stays below the threshold may be suspect; not if the model does not reach down to the noise."""
    filter_pole_rad_s: Annotated[float, Field(ge=0.1, le=1000.0, strict=True)] | None = None
    """Speed of the residual filter; None: the fastest with a noise gain of at most 0.5."""
    serial: str = ""
    """Serial number of the servo that is in now."""
    swaps: tuple[Swap, ...] = ()
    """When servos were replaced, the oldest first."""
    limits: Limits = Limits()
    """How far the servo may wear."""
    model: ModelOrigin = ModelOrigin()
    """Where the servo's model comes from: a servo that a file names is ``named`` unless it says otherwise."""
    calibrated: CalibratedServo | None = None
    """What ``servofd calibrate`` fitted to good flights; judged by it unless a constant threshold is asked for."""
    current: CurrentSource | None = None
    """Channel of its current; left out, what its own telemetry or a column of its name holds."""
    healthy_current: CalibratedCurrent | None = None
    """The current of good flights."""
    by_other_messages: bool = False
    """Whether it was calibrated, on other messages than those that a log or link has of it."""

    @property
    def tolerances(self) -> Tolerance:
        """Those of the file; else those for which the constant threshold is right."""
        return self.tolerance or Tolerance().scaled(max(1.0, self.threshold_deg / DEFAULT_THRESHOLD_DEG))

    @property
    def tells_small_faults(self) -> bool:
        """Whether the model is exact enough for suspicions below the threshold, as drafted thresholds are not."""
        known = self.tolerance is not None or self.threshold_deg <= DEFAULT_THRESHOLD_DEG
        return known and self.suspicions

    @property
    def is_told_by_current(self) -> bool:
        """Whether nothing measures where it is, and its current in good flights is known."""
        return self.measured is None and self.healthy_current is not None

    @property
    def watched_channel(self) -> str:
        """Channel by which a monitor watches it: of its position, else of its current; empty if there is neither."""
        return self._current_channel if self.measured is None else self.measured.channel

    @property
    def beside_channel(self) -> str:
        """Channel of the current by which a monitor watches it beside its position; empty if there is none."""
        return self._current_channel if self.measured is not None else ""

    @property
    def _current_channel(self) -> str:
        return self.current.channel if self.healthy_current is not None and self.current is not None else ""

    @property
    def names_servo(self) -> bool:
        """Whether its file says which servo it is."""
        return self.servo != UNKNOWN_SERVO

    @property
    def can_be_watched(self) -> bool:
        """Whether its file says what a good one does; in flight there is no log yet that would."""
        return self.names_servo or self.is_told_by_current

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for key in ("command_saturation_deg", "position_limit_deg"):
            limits = getattr(self, key)
            if limits is not None and not limits[0] < limits[1]:
                raise ValueError(f"{key} = [lower, upper] needs lower < upper, not {list(limits)}")
        if (self.command_hold == "linear") != (self.command_period_s is not None):
            raise ValueError('command_period_s belongs to command_hold = "linear", and to that alone')
        try:
            effects_installed(Physics(), self.effects)
        except ServofdError as error:
            raise ValueError(str(error)) from None
        if not self.command.channel and self.output is None:
            raise ValueError("command.channel: this key is missing, and so is output, which would do instead of it")
        dates = [swap.date for swap in self.swaps]
        if any(later <= earlier for earlier, later in itertools.pairwise(dates)):
            raise ValueError("swaps: the dates must rise, one servo after the other")
        return self


class Aircraft(Entry):
    """An aircraft: its surfaces, and the servos that are not in the library."""

    name: str = ""
    surfaces: dict[str, Surface] = {}
    motion: MotionModel | None = None
    """What the aircraft's motion tells of its axes; the only thing known of one whose servos report nothing."""
    servos: dict[str, Servo] = {}
    table: Table | None = None

    @model_validator(mode="after")
    def _servos_exist(self) -> Self:
        if not self.surfaces and self.motion is None:
            raise ValueError("surfaces: at least one entry is needed, for example [surfaces.elevator]")
        known = {**library(), **self.servos}
        for name, surface in self.surfaces.items():
            if surface.servo == UNKNOWN_SERVO:
                if surface.effects or surface.calibrated is not None:
                    raise ValueError(
                        f"surfaces.{name}.servo: this key is missing: effects and calibrations belong to a servo (in "
                        'files that name none it was "hs225bb-eq31")'
                    )
                continue
            if surface.servo not in known:
                raise ValueError(f"surfaces.{name}.servo: {suggest('servo', surface.servo, known)}")
            try:
                self.model(name)
            except DesignError as error:
                raise ValueError(f"surfaces.{name}.effects: {error}") from None
        return self

    @property
    def sharing_current(self) -> frozenset[str]:
        """Surfaces whose current is read together with that of others."""
        channels = [one.current.channel for one in self.surfaces.values() if one.current is not None]
        shared = {channel for channel in channels if channels.count(channel) > 1}
        return frozenset(n for n, one in self.surfaces.items() if one.current and one.current.channel in shared)

    def servo(self, surface: str) -> Servo:
        """Servo of a surface; the aircraft's own definitions come before the library's.

        Raises `ConfigError` if it is not named.
        """
        name = self.surfaces[surface].servo
        if name == UNKNOWN_SERVO:
            raise ConfigError(f"{surface}: no servo is named; 'servofd config --servos' lists those that are known")
        return self.servos[name] if name in self.servos else library()[name]

    def check_names(self, surfaces: Iterable[str], where: str = "") -> None:
        """Refuse names of surfaces that the aircraft does not have: `UnknownName`, which begins with `where`."""
        for name in surfaces:
            if name not in self.surfaces:
                raise UnknownName(f"{where}: " * bool(where) + suggest("surface", name, self.surfaces))

    def with_servo(self, name: str) -> Self:
        """Return the same aircraft with one servo on every surface: one of the library, or of a servo file.

        A file that ``servofd explain --save`` wrote gives each surface its servo, effects and thresholds: that of one
        surface to all, those of several to their namesakes. Raises `UnknownName` if the library has no such servo, and
        `ConfigError` if the file does not describe one, or none of these surfaces.

        Examples
        --------
        >>> plain_aircraft(["rudder"]).with_servo("s9254").surfaces["rudder"].servo
        's9254'
        """
        explained = explained_in(name)
        if explained is not None:
            return self._with_servos_of(explained, name)
        key, servo, levels = find_servo(name)
        change = {"servo": key, "model": ModelOrigin(), "calibrated": None, **levels}
        usual = {field: Surface.model_fields[field].default for field in _LEVELS}
        # The levels of a fitted servo are no other one's.
        changed = {
            surface: entry.model_copy(update=change if entry.calibrated is None else usual | change)
            for surface, entry in self.surfaces.items()
        }
        return self.model_copy(update={"surfaces": changed, "servos": {} if key == name else {key: servo}})

    def _with_servos_of(self, other: Aircraft, source: str) -> Self:
        """The same surfaces with the servos of another aircraft's."""
        only = next(iter(other.surfaces.values())) if len(other.surfaces) == 1 else None
        changed = {
            surface: entry.model_copy(update={key: getattr(found, key) for key in _OF_THE_SERVO})
            for surface, entry in self.surfaces.items()
            if (found := only or other.surfaces.get(surface)) is not None
        }
        if self.surfaces and not changed:
            raise ConfigError(f"{source} has {', '.join(other.surfaces)}, and none of {', '.join(self.surfaces)}")
        return self.model_copy(
            update={"surfaces": {**self.surfaces, **changed}, "servos": {**self.servos, **other.servos}}
        )

    def of_no_log(self) -> Self:
        """Return the same aircraft, whose fitted servos name no part of the log that they are to judge."""
        surfaces = {}
        for name, surface in self.surfaces.items():
            model = surface.model.model_copy(update={"fitted_between_s": None})
            surfaces[name] = surface.model_copy(update={"model": model})
        return self.model_copy(update={"surfaces": surfaces})

    def model(self, surface: str) -> ServoModel:
        """Healthy model of a surface: its servo, the stops of its linkage, and its effects.

        Raises `DesignError` if it has effects, and a servo with zeros or more than three poles, which none can have.
        """
        model = ServoModel.of(self.servo(surface))
        entry = self.surfaces[surface]
        if entry.position_limit_deg:
            model += PositionLimit(*entry.position_limit_deg)
        if not entry.effects:
            return model
        return model.with_physics(effects_installed(model.explainable().physics, entry.effects))


_OF_THE_SERVO = (
    "servo", "effects", "threshold", "threshold_deg", "tolerance", "persistence", "suspicions", "model", "calibrated",
)  # fmt: skip
"""What a surface owes to the servo that turns it."""
_LEVELS = ("threshold", "threshold_deg", "tolerance", "suspicions")


def explained_in(name: str) -> Aircraft | None:
    """Aircraft of a file that says which servo turns which surface; None for a servo file or one of the library."""
    if not name.endswith(".toml") or "surfaces" not in read_toml(Path(name), name, "servo file"):
        return None
    return load_aircraft(name)


def check_servo(name: str) -> None:
    """Refuse what ``--servo`` cannot take.

    Raises `ConfigError` if it is neither in the library nor a file that describes a servo.
    """
    if explained_in(name) is None:
        find_servo(name)


def plain_channels(surface: str) -> tuple[str, str]:
    """Columns of a plain table that hold command and position of a surface."""
    return f"{surface}_cmd_deg", f"{surface}_pos_deg"


def plain_aircraft(surfaces: Iterable[str], servo: str = UNKNOWN_SERVO) -> Aircraft:
    """Aircraft of a plain table: columns ``<surface>_cmd_deg`` and ``<surface>_pos_deg``, one servo for all, if any.

    Examples
    --------
    >>> plain_aircraft(["rudder"]).surfaces["rudder"].command.channel
    'rudder_cmd_deg'
    """
    return _validated(
        {
            "surfaces": {
                name: {
                    "servo": servo,
                    "command": DegreeCalibration(channel=command, unit="deg"),
                    "measured": DegreeCalibration(channel=position, unit="deg"),
                }
                for name in surfaces
                for command, position in [plain_channels(name)]
            }
        },
        "plain table",
    )


def load_aircraft(path: str | Path) -> Aircraft:
    """Read an aircraft file, or one of those that come with servofd by its bare name.

    Raises `ConfigError` if the file cannot be read, is not TOML, or does not describe an aircraft; the message names
    the file, the key, and what would have worked.

    Examples
    --------
    >>> load_aircraft("faser").servo("elevator").title
    'Hitec HS-225BB (thesis Eq. 3.1)'
    """
    return _validated(read_toml(_find(path), str(path), "aircraft file"), str(path)).of_no_log()


def _find(path: str | Path) -> Path | Traversable:
    """The file itself, or a configuration that ships with servofd when a bare name is given."""
    if Path(path).suffix or os.path.isfile(path):  # noqa: PTH113 - which takes any text for a name
        return Path(path)
    installed = resources.files("servofd").joinpath("configs")
    home = installed if installed.is_dir() else Path(__file__).parents[2] / "configs"
    known = sorted(entry.name.removesuffix(".toml") for entry in home.iterdir() if entry.name.endswith(".toml"))
    if str(path) not in known:
        raise ConfigError(f"{path}: no such file, and {suggest('aircraft', str(path), known)}")
    return home.joinpath(f"{path}.toml")


def _validated(content: Mapping[str, object], source: str) -> Aircraft:
    try:
        return Aircraft.model_validate(content)
    except ValidationError as error:
        details = error.errors(include_url=False)
        more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
        raise ConfigError(f"{source}: {_sentence(details[0])}{more}") from None


def _sentence(detail: ErrorDetails) -> str:
    """One validation error in words: where, what, and which keys would have worked."""
    # The unit that a discriminated union inserts is no key of the file.
    units = {"deg", "rad", "us", "count", "norm", "rad_or_count"}
    path = [str(part) for part in detail["loc"] if str(part) not in units]
    where = ".".join(path) or "the file"
    kind, message = detail["type"], detail["msg"].removeprefix("Value error, ")
    if kind == "extra_forbidden":
        return f"{where}: unknown key; {_siblings(detail['loc'])}"
    if kind == "missing":
        return f"{where}: this key is missing"
    if kind == "union_tag_not_found":
        return f'{where}: needs unit = "deg", "rad", "us", "count", "norm" or "rad_or_count"'
    given = detail.get("input")
    shown = f" (given: {given!r})" if isinstance(given, str | int | float | bool | list) else ""
    return f"{where}: {message}{shown}" if not message.startswith(f"{where}") else message


def _siblings(loc: Sequence[str | int]) -> str:
    """Keys that exist where an unknown one stands."""
    kinds: list[Any] = [Aircraft]
    for part in loc[:-1]:
        kinds = [inner for kind in kinds for inner in _inside(kind, part)]
    known = dict.fromkeys(name for kind in kinds for name in kind.model_fields)
    return suggest("key", str(loc[-1]), known).split("; ", 1)[-1].removeprefix("unknown key ")


def _inside(kind: Any, part: str | int) -> Iterable[Any]:  # noqa: ANN401 - a type, or several in one
    """Types of what may stand at a key or a place of another; of several in one those of this unit."""
    if get_origin(kind) in (dict, tuple):
        return _kinds(get_args(kind)[get_origin(kind) is dict])
    if part in kind.model_fields:
        return _kinds(kind.model_fields[part].annotation)
    return [kind] if part in get_args(kind.model_fields["unit"].annotation) else []


def _kinds(kind: Any) -> Iterable[Any]:  # noqa: ANN401
    """The types that may stand for one, each by itself."""
    if get_origin(kind) is Annotated:
        return _kinds(get_args(kind)[0])
    inner = get_args(kind) if get_origin(kind) in (Union, UnionType) else ()
    return [one for each in inner for one in _kinds(each) if one is not NoneType] or [kind]
