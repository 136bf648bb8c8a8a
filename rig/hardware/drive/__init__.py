"""What goes through the drive's serial link, and the stages made of it."""
