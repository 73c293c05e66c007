"""The report as files: gallery, page, and the build; no statistics."""
