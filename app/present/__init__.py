"""Results laid out for a reader: one `Document` per result, and a renderer each for terminal, HTML page and JSON.

Heavy libraries (matplotlib, rich, jinja2) are loaded by the modules that draw or print, never by this package itself.
"""
