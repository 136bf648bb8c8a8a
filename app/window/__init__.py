"""The window: a client of the engine host, which it never waits for, and of the Python API; only here is Qt imported.

| module | what |
|---|---|
| `main_window` | the application, the banner, the stop button, notices above the pages |
| `background` | engine events, live samples and file work as Qt signals |
| `widgets` | style sheet, small widgets, stored settings |
| `plots`, `trace_pyramid` | plots whose drawing time does not depend on the trace's length |
| `new_session`, `session_queue`, `live_view`, `run_page` | the page that runs plans |
| `look_page` | the page that shows runs |
| `diagnose_page` | the page that diagnoses a campaign |
"""
