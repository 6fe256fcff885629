/* The bare relay to LCM in C; it does what ../relay.py does.
 *
 *     lcm-relay URL PORT [CHANNEL FIRST LAST]...
 *
 * Of each frame that arrives from PORT of this computer, the bytes from FIRST to before LAST are published on
 * CHANNEL. FIRST is negative if they begin before the frame's packet.
 */

#include <arpa/inet.h>
#include <lcm/lcm.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

enum { MAX_CUTS = 16, BUFFER_BYTES = 512 * 1024 };

static const char REQUEST[] = "\0\0\0\x1e\0\0\0\x01StreamFrames AllFrames";

struct cut {
    const char *channel;
    long first, last;
};

static int connected(int port)
{
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons(port)};
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    int server = socket(AF_INET, SOCK_STREAM, 0);
    if (server < 0 || connect(server, (struct sockaddr *)&address, sizeof address) < 0
        || send(server, REQUEST, sizeof REQUEST - 1, 0) < 0) {
        perror("lcm-relay");
        exit(1);
    }
    return server;
}

/* Serve one connection until the server ends it. */
static void relay(lcm_t *lcm, int port, const struct cut *cuts, int num_cuts)
{
    static unsigned char unread[BUFFER_BYTES];
    long lead = -cuts[0].first, end = lead, num_read;
    int server = connected(port);
    while ((num_read = recv(server, unread + end, sizeof unread - end, 0)) > 0) {
        long at = lead, size;
        for (end += num_read; end - at >= 8; at += size) {
            const unsigned char *packet = unread + at;
            size = (long)packet[0] << 24 | packet[1] << 16 | packet[2] << 8 | packet[3];
            if (end - at < size)
                break;
            for (int i = 0; packet[7] == 3 && i < num_cuts; i++)
                lcm_publish(lcm, cuts[i].channel, packet + cuts[i].first, cuts[i].last - cuts[i].first);
        }
        memmove(unread, unread + at - lead, end - at + lead);
        end -= at - lead;
    }
    close(server);
}

int main(int argc, char **argv)
{
    struct cut cuts[MAX_CUTS];
    int num_cuts = 0;
    if (argc < 6) {
        fputs("usage: lcm-relay URL PORT [CHANNEL FIRST LAST]...\n", stderr);
        return 2;
    }
    for (int i = 3; i + 2 < argc && num_cuts < MAX_CUTS; i += 3)
        cuts[num_cuts++] = (struct cut){argv[i], atol(argv[i + 1]), atol(argv[i + 2])};
    lcm_t *lcm = lcm_create(argv[1]);
    if (!lcm)
        return 1;
    for (;;)
        relay(lcm, atoi(argv[2]), cuts, num_cuts);
}
