"""Between simulation and reality: where a gap is, what it is, and how far an amended simulator closes it.

| package | what |
|---|---|
| `where` | shares of the gap by channel, protocol, phase, speed, position, session, strain and frequency |
| `unknown` | where a gap is that no effect explains, what it depends on, and a law of it if one holds up |
"""
