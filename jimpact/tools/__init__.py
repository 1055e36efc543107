"""Tools that know no mechanics: checks of arguments, compiling, tables, progress,
statuses.
"""
