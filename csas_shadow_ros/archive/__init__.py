"""Archives: many bags processed into one folder, and a catalogue of what was found in them.

`batch.run_batch` processes, `catalogue.Catalogue` and `catalogue.rebuild` keep the tables, `find.Found` asks
them. `docs/archive.md` tells how an archive is laid out and what it costs.
"""
