/* Print the markers and events that a gateway publishes on LCM.
 *
 *   make -C examples c && examples/build/subscriber [SOURCE [COUNT]]     for example: subscriber LAB 100
 *
 * Building needs a C compiler, make, and the Python package lcm, which has LCM's library and lcm-gen. SOURCE is the
 * name of the source in upper case. The program stops after COUNT frames. The environment variable LCM_DEFAULT_URL
 * sets the LCM URL. With --vectors, the program decodes messages from standard input instead
 * (lcm_types/vectors/README.md).
 */
#define _POSIX_C_SOURCE 200809L
#include <inttypes.h>
#include <lcm/lcm.h>
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rtc3d_analog_t.h"
#include "rtc3d_clock_model_t.h"
#include "rtc3d_clock_t.h"
#include "rtc3d_command_reply_t.h"
#include "rtc3d_command_request_t.h"
#include "rtc3d_events_t.h"
#include "rtc3d_forces_t.h"
#include "rtc3d_markers_t.h"
#include "rtc3d_parameters_reply_t.h"
#include "rtc3d_parameters_request_t.h"
#include "rtc3d_parameters_t.h"
#include "rtc3d_status_t.h"
#include "rtc3d_take_t.h"
#include "rtc3d_tool_pose_t.h"
#include "rtc3d_tools_t.h"

/* Whether a component message has as many bytes as it says that it has items. The functions of lcm-gen allocate
 * memory for the items before they look, and would crash if there is not enough. */
static bool is_whole(const void *data, size_t size, size_t item_bytes)
{
    const uint8_t *count = (const uint8_t *)data + 52;
    if (size < 56)
        return false;
    return ((uint64_t)count[0] << 24 | count[1] << 16 | count[2] << 8 | count[3]) * item_bytes == size - 56;
}

static long frames_left;

static void on_markers(const lcm_recv_buf_t *buffer, const char *channel, void *user)
{
    (void)user;
    rtc3d_markers_t message;
    if (!is_whole(buffer->data, buffer->data_size, 16) ||
        rtc3d_markers_t_decode(buffer->data, 0, (int)buffer->data_size, &message) < 0) {
        fprintf(stderr, "ignored a malformed message on %s\n", channel);
        return;
    }
    const rtc3d_marker_t *first = NULL;
    int visible = 0;
    for (int i = message.num_markers - 1; i >= 0; i--) {
        if (!isnan(message.markers[i].x)) {
            first = &message.markers[i];
            visible++;
        }
    }
    printf("#%" PRId64 " frame %d at %.4f s with parameters %d: %d of %d markers in view", message.sequence,
           message.frame_number, message.timestamp / 1e6, message.parameters_version, visible,
           message.num_markers);
    if (first)
        printf(", the first at %.3f, %.3f, %.3f mm", first->x, first->y, first->z);
    printf("\n");
    fflush(stdout);
    rtc3d_markers_t_decode_cleanup(&message);
    frames_left--;
}

static void on_events(const lcm_recv_buf_t *buffer, const char *channel, void *user)
{
    (void)user;
    rtc3d_events_t message;
    if (!is_whole(buffer->data, buffer->data_size, 24) ||
        rtc3d_events_t_decode(buffer->data, 0, (int)buffer->data_size, &message) < 0) {
        fprintf(stderr, "ignored a malformed message on %s\n", channel);
        return;
    }
    for (int i = 0; i < message.num_events; i++) {
        const rtc3d_event_t *event = &message.events[i];
        printf("event 0x%x at %.4f s: %d %d %d\n", (unsigned)event->id, event->timestamp / 1e6, event->param1,
               event->param2, event->param3);
    }
    fflush(stdout);
    rtc3d_events_t_decode_cleanup(&message);
}

static int subscribe(const char *source, long count)
{
    lcm_t *lcm = lcm_create(NULL);
    if (!lcm) {
        fprintf(stderr, "Cannot open LCM; check $LCM_DEFAULT_URL and the multicast route\n");
        return 1;
    }
    char channel[64];
    snprintf(channel, sizeof channel, "MOCAP_%s_3D", source);
    /* The default of 30 messages loses frames whenever this program pauses. */
    lcm_subscription_set_queue_capacity(lcm_subscribe(lcm, channel, on_markers, NULL), 1000);
    snprintf(channel, sizeof channel, "MOCAP_%s_EVENT", source);
    lcm_subscription_set_queue_capacity(lcm_subscribe(lcm, channel, on_events, NULL), 1000);
    fprintf(stderr, "listening\n");
    frames_left = count;
    while ((count == 0 || frames_left > 0) && lcm_handle(lcm) == 0)
        ;
    lcm_destroy(lcm);
    return 0;
}

/* The rest is for --vectors: any message as JSON, by the descriptions that `lcm-gen --c-typeinfo` adds to each type. */

#define TYPE(name) #name, rtc3d_##name##_get_type_info

static const struct type {
    const char *name;
    const lcm_type_info_t *(*info)(void);
    size_t item_bytes; /* of a component message; 0 for others */
} types[] = {
    {TYPE(markers_t), 16},         {TYPE(tools_t), 32},          {TYPE(analog_t), 4},
    {TYPE(forces_t), 24},          {TYPE(events_t), 24},         {TYPE(tool_pose_t), 0},
    {TYPE(status_t), 0},           {TYPE(clock_t), 0},           {TYPE(parameters_t), 0},
    {TYPE(parameters_request_t), 0}, {TYPE(parameters_reply_t), 0}, {TYPE(command_request_t), 0},
    {TYPE(command_reply_t), 0},    {TYPE(take_t), 0},
    /* parts of messages */
    {TYPE(marker_t), 0},           {TYPE(tool_t), 0},            {TYPE(force_t), 0},
    {TYPE(event_t), 0},            {TYPE(clock_model_t), 0},     {TYPE(count_t), 0},
    {TYPE(loss_t), 0},             {TYPE(stream_status_t), 0},   {TYPE(output_status_t), 0},
};

static const struct type *find_type(const char *name)
{
    for (size_t i = 0; i < sizeof types / sizeof types[0]; i++) {
        if (strcmp(types[i].name, name) == 0)
            return &types[i];
    }
    return NULL;
}

static void print_text(const char *text)
{
    putchar('"');
    for (; *text; text++) {
        if ((unsigned char)*text < ' ')
            printf("\\u%04x", *text);
        else if (*text == '"' || *text == '\\')
            printf("\\%c", *text);
        else
            putchar(*text);
    }
    putchar('"');
}

static void print_number(double value, int digits)
{
    if (isfinite(value))
        printf("%.*g", digits, value);
    else
        printf("\"%s\"", isnan(value) ? "nan" : value > 0 ? "inf" : "-inf");
}

static void print_struct(const lcm_type_info_t *info, const void *message);

/* Print the value at `data`, and return the value after it. */
static const void *print_value(const lcm_field_t *field, const void *data)
{
    switch (field->type) {
    case LCM_FIELD_INT32_T:
        printf("%" PRId32, *(const int32_t *)data);
        return (const int32_t *)data + 1;
    case LCM_FIELD_INT64_T:
        printf("%" PRId64, *(const int64_t *)data);
        return (const int64_t *)data + 1;
    case LCM_FIELD_FLOAT:
        print_number(*(const float *)data, 9);
        return (const float *)data + 1;
    case LCM_FIELD_DOUBLE:
        print_number(*(const double *)data, 17);
        return (const double *)data + 1;
    case LCM_FIELD_BOOLEAN:
        printf(*(const int8_t *)data ? "true" : "false");
        return (const int8_t *)data + 1;
    case LCM_FIELD_STRING:
        print_text(*(char *const *)data);
        return (char *const *)data + 1;
    case LCM_FIELD_USER_TYPE: {
        const lcm_type_info_t *info = find_type(field->typestr)->info();
        print_struct(info, data);
        return (const char *)data + info->struct_size();
    }
    default:
        fprintf(stderr, "no field of the gateway is a %s\n", field->typestr);
        exit(1);
    }
}

static void print_struct(const lcm_type_info_t *info, const void *message)
{
    for (int i = 0; i < info->num_fields(); i++) {
        lcm_field_t field;
        info->get_field(message, i, &field);
        printf("%s\"%s\": ", i == 0 ? "{" : ", ", field.name);
        if (field.num_dim == 0) {
            print_value(&field, field.data);
            continue;
        }
        const void *item = field.dim_is_variable[0] ? *(void **)field.data : field.data;
        printf("[");
        for (int32_t k = 0; k < field.dim_size[0]; k++) {
            printf(k == 0 ? "" : ", ");
            item = print_value(&field, item);
        }
        printf("]");
    }
    printf("}");
}

static void print_vector(const char *type_name, const uint8_t *data, size_t size)
{
    const struct type *type = find_type(type_name);
    if (!type) {
        printf("{\"error\": \"unknown type\"}\n");
        return;
    }
    const lcm_type_info_t *info = type->info();
    void *message = calloc(1, info->struct_size());
    if ((type->item_bytes && !is_whole(data, size, type->item_bytes)) ||
        info->decode(data, 0, (int)size, message) != (int)size) {
        printf("{\"error\": \"%zu bytes are not a whole %s\"}\n", size, type_name);
    } else {
        print_struct(info, message);
        printf("\n");
        info->decode_cleanup(message);
    }
    free(message);
}

/* Read lines TYPE HEX. */
static int print_vectors(void)
{
    char *line = NULL;
    size_t capacity = 0;
    while (getline(&line, &capacity, stdin) > 0) {
        const char *type_name = strtok(line, " \n");
        const char *digits = strtok(NULL, " \n");
        size_t size = 0;
        uint8_t *data = (uint8_t *)line; /* shorter than the digits, which follow */
        char name[64];
        snprintf(name, sizeof name, "%s", type_name ? type_name : "");
        unsigned byte;
        for (; digits && sscanf(digits, "%2x", &byte) == 1; digits += 2)
            data[size++] = (uint8_t)byte;
        print_vector(name, data, size);
    }
    free(line);
    return 0;
}

int main(int argc, char **argv)
{
    if (argc > 1 && strcmp(argv[1], "--vectors") == 0)
        return print_vectors();
    if (argc > 1 && argv[1][0] == '-') {
        printf("Print the markers and events that a gateway publishes on LCM.\n"
               "Usage: %s [SOURCE [COUNT]]\n       %s --vectors < LINES\n",
               argv[0], argv[0]);
        return strcmp(argv[1], "--help") == 0 ? 0 : 2;
    }
    return subscribe(argc > 1 ? argv[1] : "LAB", argc > 2 ? atol(argv[2]) : 0);
}
