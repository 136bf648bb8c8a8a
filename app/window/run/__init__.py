"""The page that runs plans: form, preview, queue, live traces."""
