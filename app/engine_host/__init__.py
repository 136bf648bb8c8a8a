"""The engine in a process of its own: it owns rig, session and recorder; whoever shows them is its client.

| module | what |
|---|---|
| `messages` | what client and host tell each other: small frozen values |
| `live` | samples on their way to a screen, through shared memory that the engine never waits for |
| `client` | starts a host, asks it, hears it |
| `server` | the host's process: one request after the other |
| `listening` | the host's ear: hears stops at once, notices when its client is gone, and never makes the engine wait |
| `person` | the client as the session's operator and watcher |

When the client dies or falls silent, the stage is stopped, the run file is finished with the reason in it, and the
process ends.
"""
