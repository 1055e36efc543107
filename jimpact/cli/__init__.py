"""The command line: commands, options, studies built of files, programs kept between calls."""
