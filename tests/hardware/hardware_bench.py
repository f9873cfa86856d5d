"""A bench for the tests: simulated devices at the ends of lines, and the drivers that talk to them."""

import tempfile
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from made_recipe import made_of
from simulated_devices.espec import SimulatedEspec
from simulated_devices.frames import SimulatedFrames
from simulated_devices.line_chambers import SimulatedCts
from simulated_devices.line_tables import SimulatedAerosmith, SimulatedGrbl
from simulated_devices.port import SimulatedPort
from simulated_devices.watlow_f4t import SimulatedWatlowF4T
from simulated_devices.wire import Wire, line_to

from gradcal_jax.cli import main
from gradcal_jax.formulas import EARTH_RATE
from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.drivers import lines, registers
from gradcal_jax.hardware.interlocks import InterlockLimits
from gradcal_jax.hardware.journal import Chunk, Journal, read_journal
from gradcal_jax.hardware.roles import STANDARD_GRAVITY
from gradcal_jax.hardware.runner import Runner
from gradcal_jax.hardware.setup import only_of, open_rig
from gradcal_jax.hardware.simulate.imu import (
    FACTORS,
    ErrorTerm,
    ImuTruth,
    SimulatedImu,
    TableTruth,
    TriadTruth,
)
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.hardware.track import track_of
from gradcal_jax.recipe.tracks import Stability
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.rig import TEMPLATE, parse_rig, rig_of
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.writing import write_toml

# The simulated board takes accelerations that no stepper motor does, so that tests are short, and starts at once.
BOARD_CHANGES = {
    "limits": {"max_rate": "300 deg/s", "max_acceleration": "2000 deg/s^2"},
    "line": {"boot": "0 s"},
}


@contextmanager
def served(device, clock, baudrate, **options):
    """A device at the end of a line in memory, and the host's end of it."""
    with Wire(device, clock, **options) as port:
        transport = line_to(port.url, clock=clock, baudrate=baudrate)
        try:
            with clock.party():
                yield port, transport
        finally:
            transport.close()


def espec_config(pause="0.1 s"):
    changes = {"line": {"pause": pause, "pause_after_command": "1 s"}}
    return lines.LinesConfig(protocol="espec", changes=changes, reply_timeout="0.3 s")


def lines_config(protocol, **more):
    return lines.LinesConfig(protocol=protocol, reply_timeout="0.2 s", home_timeout="2.0 s", **more)


def _bench(simulated, plant_of, config_of):
    """A context with the driver, its simulated device, the port between them, and their clock."""

    @contextmanager
    def bench(config=None, **port_options):
        clock, config = VirtualClock(), config or config_of()
        device = simulated(plant_of(), clock)
        with served(device, clock, config.line_settings["baudrate"], **port_options) as (port, transport):
            yield config.device(config.link(transport, clock), clock), device, port, clock

    return bench


chamber_plant = partial(ChamberPlant, ChamberTruth())
_F4T = registers.RegistersConfig(protocol="watlow-f4t", reply_timeout="0.2 s")
espec_bench = _bench(SimulatedEspec, chamber_plant, espec_config)
f4t_bench = _bench(SimulatedWatlowF4T, chamber_plant, lambda: _F4T)
cts_bench = _bench(SimulatedCts, chamber_plant, partial(lines_config, "cts"))
grbl_bench = _bench(SimulatedGrbl, AxisPlant, partial(lines_config, "grbl"))
aerosmith_bench = _bench(SimulatedAerosmith, AxisPlant, partial(lines_config, "aerosmith-like"))


EARTH_RATE_DPS = float(np.degrees(EARTH_RATE))


def perfect(*, scale_factor=0.0, clock_error=0.0):
    """A unit without noise, whose gyros have a scale-factor error."""
    error = ErrorTerm(np.full((3, 1, 1), scale_factor), None, FACTORS["scale_factor"])
    triads = {"gyro": TriadTruth({"scale_factor": error}, 0.0), "accelerometer": TriadTruth({}, 0.0)}
    return ImuTruth(triads, clock_error=clock_error)


def sensor_on_table(clock, truth=None, *, sample_rate_hz=125.0, axis=None, chamber=None, seed=1):
    """A unit on a vertical axis, at 45 degrees of latitude."""
    return SimulatedImu(
        truth or perfect(),
        TableTruth(((0.0, 0.0, 1.0),), np.pi / 4.0, STANDARD_GRAVITY),
        chamber or chamber_plant(clock.now()),
        [axis or AxisPlant(None, clock.now())],
        sample_rate_hz=sample_rate_hz,
        seed=seed,
        start_s=clock.now(),
    )


def chamber_alone(protocol, *, port="COM1", options=(), **more):
    """A rig file of one chamber."""
    table = {"driver": "lines", "port": port, "safe": "standby", "options": {"protocol": protocol} | dict(options)}
    return rig_of({"format": "gradcal-rig/1", "chamber": table | more})


def rig_with(rig, **tables):
    """A rig file with other tables."""
    return rig_of(rig.model_dump(mode="json", exclude_unset=True) | tables)


def gradcal_run(folder, rig, *words):
    """`gradcal run` of a short recipe."""
    write_toml(short_recipe(), folder / "recipe.toml")
    write_toml(rig, folder / "rig.toml")
    return main(["run", str(folder / "recipe.toml"), "--rig", str(folder / "rig.toml"), *words])


class Rig:
    """A simulated rig under the template's rig file, on lines in memory, or on pseudo-terminals for other processes.
    The unit sends its samples every `burst_s`. The board is opened without its waiting time."""

    def __init__(self, clock, truth=None, *, burst_s=0.128, on_terminals=False):
        plant = ChamberPlant(ChamberTruth(start_c=24.8, load_time_constant_s=60.0), clock.now())
        axis = AxisPlant(None, clock.now())
        self.chamber = SimulatedEspec(plant, clock)
        self.axis, self.clock = axis, clock
        self.table = SimulatedGrbl(axis, clock)
        self.sensor = sensor_on_table(clock, truth, axis=axis, chamber=plant)
        self.imu = SimulatedFrames(self.sensor, clock, burst_s=burst_s)
        line = SimulatedPort if on_terminals else Wire
        self.ports = [line(device, clock) for device in (self.chamber, self.table, self.imu)]
        text = TEMPLATE
        for index, port in enumerate(self.ports):
            text = text.replace(f"/dev/ttyUSB{index}", port.open().url)
        self.rig = parse_rig(text)
        self.rig.axis[0].options["changes"] = BOARD_CHANGES

    def rate_dps(self):
        return self.axis.state(self.clock.now())[1]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for port in self.ports:
            port.__exit__()


def chunks_of(contents, line):
    """What was received on a line."""
    return [
        record for record in contents.records if isinstance(record, Chunk) and record.received and record.line == line
    ]


def parse_journal(data):
    """What a journal of these bytes holds."""
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        return read_journal(Path(file.name))


def short_recipe(ramp_k=4.0, *, changes=None):
    """A recipe of minutes: a soak, then a ramp of 2 K/min with turns, of the paper's gyro."""
    moves = [
        {"rest": "4 s", "read_every": "1 s"},
        {"turn": "360 deg", "peak_rate": "200 deg/s", "shape": "linear ramps"},
        {"rest": "3 s", "read_every": "1 s"},
        {"turn": "-360 deg", "peak_rate": "150 deg/s", "shape": "linear ramps"},
    ]
    keys = {
        "plan.temperature": ["24 degC", f"{24.0 + ramp_k:g} degC"],
        "plan.gradient": "2 K/min",
        "plan.soak": "5 s",
        "plan.cycle.moves": moves,
        "plan.cycle.other_axes": {"duration": "2 s", "read_every": "1 s"},
    }
    return unpredicted(changed(parse_spec(presets.text("paper-dynamic-gradient")), keys | (changes or {})))


def unpredicted(spec):
    """A recipe whose prediction is empty: what can be made without compiling anything."""
    return made_of(spec, Stability(for_at_least=Quantity.read("20 s", "time")))


@contextmanager
def running(folder, track, truth=None, *, limits=None, with_unit=True, **more):
    """A rig and the runner of a track on it, in virtual time; its journal lies in the folder."""
    clock = VirtualClock()
    folder.mkdir(exist_ok=True)
    with Rig(clock, truth, burst_s=0.256) as rig, Journal(folder / "journal") as journal:
        devices = rig.rig if with_unit else only_of(rig.rig, {"chamber", "table"})
        with open_rig(devices, clock) as bench:
            more = {"safe_deadline_s": 10.0} | more
            yield rig, Runner(track, bench, journal, clock, limits or InterlockLimits(), **more)


def short_track():
    return track_of(short_recipe(2.0), ["table"])


def events(folder, name):
    return [event for event in read_journal(folder / "journal").events if event.name == name]


def ends_aborted(runner, *words):
    """Run to an end that is safe, verified, and says so of its reason."""
    result = runner.run()
    assert (result.exit_status, result.verified_safe) == ("aborted", True), result
    for said in words:
        assert said in result.reason, result.reason
    return result


def acting(runner, when, act, every_s=1.0):
    """Act from within the run, the first time that its progress, shown each `every_s`, is so."""
    acts = [act]

    def look(progress):
        if acts and when(progress):
            acts.pop()()

    runner.chamber_every_s = every_s
    runner.on_progress = look


def struck(folder, track, when, harm, *words, ready=lambda rig: None, every_s=1.0, **more):
    """A run that harm befalls, once its progress is so: its rig, its end, and the time of the harm (s). With words:
    it ends aborted and safe, and says so."""
    with running(folder, track, **more) as (rig, runner):
        struck_s = []
        ready(rig)
        acting(runner, partial(when, rig=rig), lambda: (struck_s.append(rig.clock.now()), harm(rig)), every_s)
        result = ends_aborted(runner, *words) if words else runner.run()
    return rig, result, struck_s[0]


def in_step(number):
    """Once the step of this number has begun."""
    return lambda progress, rig=None: progress.steps_done == number and progress.step_left_s is not None
