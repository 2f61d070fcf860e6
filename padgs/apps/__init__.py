"""Programs that use finished runs: viewer, export, camera-path video, benchmark."""
