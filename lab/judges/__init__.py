"""Labels of real recordings, and the judges that compare results with them."""
