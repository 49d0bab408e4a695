"""edge-se view: a run in the browser, by viser."""
