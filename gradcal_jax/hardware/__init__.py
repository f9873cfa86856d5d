"""The hardware layer: device roles, serial lines, drivers, simulated devices. No JAX in this package.

    transport → framing → codec → driver → role

`transport` moves bytes, `framing` and the codecs (in each driver's file) are pure, a driver has state, units and
retries, and a role (`roles`) is what the rest of the program sees. `simulate` holds devices at the level of the roles;
byte-exact peers of every protocol are in `tests/hardware`. No driver has been run on real hardware yet; each one's
docstring names what its sources leave open.
"""
