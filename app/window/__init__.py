"""The window: a client of the engine's host, which it never waits for, and of the Python API.

| module | what |
|---|---|
| `application` | the program: window, engine, the end |
| `main_window` | pages, the rig's banner, the stop button, notices |
| `engine_link` | the engine's events and live samples as Qt signals |
| `theme`, `words` | how everything looks, and small widgets |
| `remembered` | settings kept from one day to the next |
| `background` | work on files beside the screen's thread |
| `plots/` | traces that cost the same to draw however long they are |
| `run/`, `look/`, `diagnose/` | the pages |

Only this package imports Qt.
"""
