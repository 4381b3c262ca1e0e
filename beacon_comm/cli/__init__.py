"""The command lines: thin, and the only room that may use all others."""

from beacon_comm.compiling.cache import ensure_compiler_cache

ensure_compiler_cache()  # before anything imports numba
