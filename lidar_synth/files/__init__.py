"""How bytes come from disk and go to disk: whole files, bounded parsers, clear errors."""
