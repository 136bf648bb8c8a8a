"""The engine in its own process, which owns rig, session and recorder; the window is its client.

| module | content |
|---|---|
| `messages` | requests and events as small frozen values, and the shared-memory ring of live samples |
| `client` | starts a host, sends requests, reads events |
| `server` | the host process: request queue, connection threads, operator prompts |

When the client dies or falls silent, the stage is stopped, the run file is finished with the reason in it, and the
process ends.

`__init__.pyi` lists the public names and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
