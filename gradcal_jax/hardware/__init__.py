"""The hardware layer: runs of a recipe on real or simulated devices. No JAX in this package.

A recipe and a rig file come in; a run's folder with its journal goes out, and every device is left safe.

    track, dry_run                what a recipe asks of each device, and what these do not accept
    execute, runner, supervision  sessions of a run, its steps, its states and its status file
    axis_control, chamber_control, unit_control    commands and readings, and what is wrong with them
    interlocks                    the rules that hold in every state
    journal, run_folder, guard    what is recorded, resumed, and made safe by another process
    setup, roles, drivers         from the rig file to devices: `roles` is what the rest of the program sees
    line_protocol, register_protocol, frames, text_unit    devices that are described without code
    transport, checksums, request_reply, clock    bytes, checks, replies, time

`simulate` holds devices at the level of the roles; byte-exact peers of every protocol are in `tests/hardware`. No
driver has been run on real hardware yet; each one's docstring names what its sources leave open.
"""
