"""The original script, faithfully: the functions behind the stages `classic_*`."""
