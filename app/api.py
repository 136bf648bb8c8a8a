"""What people type they can also call: the functions behind `import dragrig`."""
