"""The command line: commands, options, studies built of files, stored programs."""
