/* Print the markers and events that a gateway publishes on LCM.
 *
 *   make -C examples && examples/build/subscriber [SOURCE [COUNT]]     for example: subscriber LAB 100
 *
 * SOURCE is the name of the source in upper case. The program stops after COUNT frames.
 * The environment variable LCM_DEFAULT_URL sets the LCM URL. Without it, LCM uses its default.
 */
#include <lcm/lcm.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rtc3d_events_t.h"
#include "rtc3d_markers_t.h"

static long frames_left;

static void on_markers(const lcm_recv_buf_t *buffer, const char *channel, const rtc3d_markers_t *message,
                       void *user)
{
    (void)buffer;
    (void)user;
    printf("%s sequence %lld frame %d with parameters %d:", channel, (long long)message->sequence,
           message->frame_number, message->parameters_version);
    for (int i = 0; i < message->num_markers; i++) {
        const rtc3d_marker_t *marker = &message->markers[i];
        if (isnan(marker->x))
            printf(" missing");
        else
            printf(" %.3f,%.3f,%.3f", marker->x, marker->y, marker->z);
    }
    printf("\n");
    frames_left--;
}

static void on_events(const lcm_recv_buf_t *buffer, const char *channel, const rtc3d_events_t *message,
                      void *user)
{
    (void)buffer;
    (void)user;
    for (int i = 0; i < message->num_events; i++) {
        const rtc3d_event_t *event = &message->events[i];
        printf("%s event 0x%x at %lld us: %d %d %d\n", channel, (unsigned)event->id,
               (long long)event->timestamp, event->param1, event->param2, event->param3);
    }
}

int main(int argc, char **argv)
{
    if (argc > 1 && argv[1][0] == '-') {
        printf("Print the markers and events that a gateway publishes on LCM.\nUsage: %s [SOURCE [COUNT]]\n",
               argv[0]);
        return strcmp(argv[1], "--help") == 0 ? 0 : 2;
    }
    const char *source = argc > 1 ? argv[1] : "LAB";
    char channel[64];
    frames_left = argc > 2 ? atol(argv[2]) : 0;
    const int run_forever = frames_left == 0;

    lcm_t *lcm = lcm_create(NULL);
    if (!lcm) {
        fprintf(stderr, "Cannot open LCM; check $LCM_DEFAULT_URL and the multicast route\n");
        return 1;
    }
    snprintf(channel, sizeof channel, "MOCAP_%s_3D", source);
    rtc3d_markers_t_subscribe(lcm, channel, on_markers, NULL);
    snprintf(channel, sizeof channel, "MOCAP_%s_EVENT", source);
    rtc3d_events_t_subscribe(lcm, channel, on_events, NULL);
    fprintf(stderr, "listening\n");
    while ((run_forever || frames_left > 0) && lcm_handle(lcm) == 0)
        ;
    lcm_destroy(lcm);
    return 0;
}
