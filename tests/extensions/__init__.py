"""What a user may add to cpjax, each as one new file: no file of the package knows any of these."""
