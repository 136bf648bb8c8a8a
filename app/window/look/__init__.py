"""The page that looks at runs: browser, overlay, cursors, filter, steady table, export."""
