"""Records joint positions and current references of industrial drives into MCAP files.

The rooms, ground floor first. Each is entered by its face, what its `__init__` shows; imports only run down::

    files        files written whole or not at all, columns of tables
    protocol     CANopen (CiA 301) and CiA 402 without I/O: states, objects, SDO, PDO, object dictionaries
    robot        the description (robot.toml): joints, motors, limits, the bus and its drives
    recording    the MCAP format: rows, reader, writer, recovery, summary
    trajectory   reference trajectories, checked against the limits
    transport    the bus as frames and times; logs of other tools
    master       the CANopen master: listening, requests, heartbeat, supervision, the one stop of all drives
    recorder     frames into a recording by a process of its own, decoding, the second stop
    simulated    simulated drives, the plants they move, dry runs
    session      the one loop that sends: record, enable, track, stop; its guards
    importing    recordings out of tables and CAN logs
    commands     the command line
"""
