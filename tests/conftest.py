"""Settings for all tests: hypothesis tries the same examples each time, so a red test stays red."""

from hypothesis import settings

settings.register_profile("tscorr", derandomize=True, deadline=None)
settings.load_profile("tscorr")
