"""Watching a trial: a page in the browser, and Rerun. Nothing here changes an estimate."""
