"""stub to be replaced"""
def write_archive_page(path, title, rows, people): pass
