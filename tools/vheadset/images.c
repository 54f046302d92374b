// SPDX-License-Identifier: GPL-3.0-or-later
#include "images.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

enum { PATH_BYTES = 1200 };

int images_load(const char *directory, const char *name, uint8_t *data, size_t bytes, char *error,
                size_t error_bytes)
{
    char path[PATH_BYTES];
    snprintf(path, sizeof path, "%s/%s", directory, name);
    FILE *file = fopen(path, "rb");
    if (!file) {
        if (errno == ENOENT)
            return 0;
        snprintf(error, error_bytes, "cannot read %s: %s", path, strerror(errno));
        return -1;
    }
    int whole = fseek(file, 0, SEEK_END) == 0 && ftell(file) == (long)bytes;
    rewind(file);
    if (!whole || fread(data, 1, bytes, file) != bytes) {
        snprintf(error, error_bytes, "%s is not an image of %zu bytes: remove it", path, bytes);
        fclose(file);
        return -1;
    }
    fclose(file);
    return 0;
}

int images_save(const char *directory, const char *name, const uint8_t *data, size_t bytes)
{
    char path[PATH_BYTES], temporary[PATH_BYTES + 16];
    snprintf(path, sizeof path, "%s/%s", directory, name);
    snprintf(temporary, sizeof temporary, "%s.%ld", path, (long)getpid());
    FILE *file = fopen(temporary, "wb");
    if (!file)
        return -1;
    size_t written = fwrite(data, 1, bytes, file);
    if (fclose(file) || written != bytes || rename(temporary, path)) {
        int keep = errno;
        unlink(temporary);
        errno = keep;
        return -1;
    }
    return 0;
}
