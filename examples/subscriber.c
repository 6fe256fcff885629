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
#include <ctype.h>
#include <inttypes.h>
#include <lcm/lcm.h>
#include <limits.h>
#include <locale.h>
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#include <wchar.h>

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
#include "rtc3d_take_details_t.h"
#include "rtc3d_take_end_t.h"
#include "rtc3d_take_t.h"
#include "rtc3d_tool_pose_t.h"
#include "rtc3d_tools_t.h"

/* The functions of lcm-gen trust a message: they allocate as many items as it says that it has, and expect a NUL at the
 * end of each text. So that a damaged message does no harm, this program first walks through the bytes, with the
 * descriptions of the types that `lcm-gen --c-typeinfo` adds. */

#define TYPE(name) {#name, rtc3d_##name##_get_type_info}

static const struct type {
    const char *name;
    const lcm_type_info_t *(*info)(void);
} types[] = {
    TYPE(markers_t), TYPE(tools_t), TYPE(analog_t), TYPE(forces_t), TYPE(events_t), TYPE(tool_pose_t), TYPE(status_t),
    TYPE(clock_t), TYPE(parameters_t), TYPE(parameters_request_t), TYPE(parameters_reply_t), TYPE(command_request_t),
    TYPE(command_reply_t), TYPE(take_t), TYPE(take_details_t), TYPE(take_end_t),
    /* parts of messages */
    TYPE(marker_t), TYPE(tool_t), TYPE(force_t), TYPE(event_t), TYPE(clock_model_t), TYPE(count_t), TYPE(loss_t),
    TYPE(stream_status_t), TYPE(output_status_t),
};

static const lcm_type_info_t *find_type(const char *name)
{
    for (size_t i = 0; i < sizeof types / sizeof types[0]; i++) {
        if (strcmp(types[i].name, name) == 0)
            return types[i].info();
    }
    return NULL;
}

static int32_t read_int32(const uint8_t *data)
{
    return (int32_t)((uint32_t)data[0] << 24 | (uint32_t)data[1] << 16 | (uint32_t)data[2] << 8 | data[3]);
}

static bool walk_struct(const lcm_type_info_t *info, const uint8_t **data, const uint8_t *end);

/* Return whether a text is UTF-8, in a locale that is. */
static bool is_utf8(const char *text)
{
    mbstate_t state = {0};
    wchar_t letter;
    size_t size; /* 0 for the NUL; larger than MB_CUR_MAX if this is no letter */
    while ((size = mbrtowc(&letter, text, MB_CUR_MAX, &state)) > 0 && size <= MB_CUR_MAX && letter <= 0x10ffff)
        text += size;
    return size == 0;
}

/* Move `data` behind a value. Return false if it ends behind `end`, or is a text that is not UTF-8 up to a NUL. */
static bool walk_value(const lcm_field_t *field, const uint8_t **data, const uint8_t *end)
{
    int64_t size = 0;
    switch (field->type) {
    case LCM_FIELD_INT64_T:
    case LCM_FIELD_DOUBLE:
        size = 8;
        break;
    case LCM_FIELD_INT32_T:
    case LCM_FIELD_FLOAT:
        size = 4;
        break;
    case LCM_FIELD_BOOLEAN:
        size = 1;
        break;
    case LCM_FIELD_STRING:
        size = end - *data < 4 ? -1 : read_int32(*data);
        if (size < 1 || size > end - *data - 4 || memchr(*data + 4, 0, size) != *data + 4 + size - 1 ||
            !is_utf8((const char *)*data + 4))
            return false;
        size += 4;
        break;
    case LCM_FIELD_USER_TYPE:
        return walk_struct(find_type(field->typestr), data, end);
    default:
        return false; /* no field of the gateway */
    }
    if (size > end - *data)
        return false;
    *data += size;
    return true;
}

static bool walk_struct(const lcm_type_info_t *info, const uint8_t **data, const uint8_t *end)
{
    void *numbers = calloc(1, info->struct_size()); /* of items: get_field looks them up in a message */
    bool is_whole = true;
    for (int i = 0; i < info->num_fields() && is_whole; i++) {
        lcm_field_t field;
        info->get_field(numbers, i, &field);
        const int32_t items = field.num_dim == 0 ? 1 : field.dim_size[0];
        is_whole = items >= 0;
        for (int32_t k = 0; k < items && is_whole; k++)
            is_whole = walk_value(&field, data, end);
        if (is_whole && field.num_dim == 0 && field.type == LCM_FIELD_INT32_T)
            *(int32_t *)field.data = read_int32(*data - 4);
    }
    free(numbers);
    return is_whole;
}

/* Decode into `message`, which has the size of the type. Return whether the bytes are one whole message. */
static bool decode(const lcm_type_info_t *info, const void *bytes, size_t size, void *message)
{
    const uint8_t *data = bytes, *end = data + size;
    if (size < 8 || size > INT_MAX)
        return false;
    data += 8; /* the fingerprint, which the function of lcm-gen checks */
    return walk_struct(info, &data, end) && data == end && info->decode(bytes, 0, (int)size, message) >= 0;
}

static long frames_left = LONG_MAX;
static int64_t newest = -1; /* the number of the newest frame; -1 before the first */

static void show(const rtc3d_markers_t *markers)
{
    const rtc3d_markers_t message = *markers;
    newest = message.sequence;
    if (frames_left-- <= 0)
        return;
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
}

static lcm_t *queries; /* requests to the gateway, and what it sends again */
static const char *source_name;

static void on_refill(const lcm_recv_buf_t *buffer, const char *channel, void *user)
{
    (void)channel, (void)user;
    rtc3d_markers_t message;
    if (!decode(rtc3d_markers_t_get_type_info(), buffer->data, buffer->data_size, &message))
        return;
    if (message.sequence == newest + 1)
        show(&message);
    rtc3d_markers_t_decode_cleanup(&message);
}

/* Ask the gateway for the frames after the newest one, up to `last`, as long as any come. */
static void refill(int64_t last)
{
    static int64_t request_id;
    char requester[64], channel[64], from[32], to[32];
    snprintf(requester, sizeof requester, "subscriber.c %ld at %ld", (long)getpid(), (long)time(NULL));
    snprintf(channel, sizeof channel, "MOCAP_%s_COMMAND_REQUEST", source_name);
    for (int tries_left = 5; newest < last && tries_left > 0; tries_left--) {
        const int64_t before = newest;
        snprintf(from, sizeof from, "from=%" PRId64, newest + 1);
        snprintf(to, sizeof to, "to=%" PRId64, last);
        char *options[] = {"key=3d", from, to};
        const rtc3d_command_request_t request = {++request_id, requester, "history", 3, options};
        rtc3d_command_request_t_publish(queries, channel, &request);
        while (newest < last && lcm_handle_timeout(queries, 200) > 0)
            ;
        if (newest > before)
            tries_left = 6;
    }
}

static void on_markers(const lcm_recv_buf_t *buffer, const char *channel, void *user)
{
    (void)user;
    rtc3d_markers_t message;
    if (!decode(rtc3d_markers_t_get_type_info(), buffer->data, buffer->data_size, &message)) {
        fprintf(stderr, "ignored a malformed message on %s\n", channel);
        return;
    }
    if (newest >= 0)
        refill(message.sequence - 1);
    show(&message);
    rtc3d_markers_t_decode_cleanup(&message);
}

static void on_events(const lcm_recv_buf_t *buffer, const char *channel, void *user)
{
    (void)user;
    rtc3d_events_t message;
    if (!decode(rtc3d_events_t_get_type_info(), buffer->data, buffer->data_size, &message)) {
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
    const char *url = getenv("LCM_DEFAULT_URL"), *colon, *rest = "";
    if (!url || !*url)
        url = "udpm://239.255.76.67:7667";
    /* Requests go to the next port. */
    char queries_url[256];
    colon = strrchr(url, ':');
    const long port = colon ? strtol(colon + 1, (char **)&rest, 10) : 0;
    snprintf(queries_url, sizeof queries_url, "%.*s:%ld%s", colon ? (int)(colon - url) : 0, url, port + 1, rest);
    lcm_t *lcm = lcm_create(url);
    queries = lcm ? lcm_create(queries_url) : NULL;
    if (!queries) {
        fprintf(stderr, "Cannot open LCM; check $LCM_DEFAULT_URL and the multicast route\n");
        return 1;
    }
    char channel[64];
    snprintf(channel, sizeof channel, "MOCAP_%s_3D", source);
    /* The default of 30 messages loses frames whenever this program pauses. */
    lcm_subscription_set_queue_capacity(lcm_subscribe(lcm, channel, on_markers, NULL), 1000);
    source_name = source;
    snprintf(channel, sizeof channel, "MOCAP_%s_3D_REFILL", source);
    lcm_subscription_set_queue_capacity(lcm_subscribe(queries, channel, on_refill, NULL), 5000);
    snprintf(channel, sizeof channel, "MOCAP_%s_EVENT", source);
    lcm_subscription_set_queue_capacity(lcm_subscribe(lcm, channel, on_events, NULL), 1000);
    printf("listening\n");
    fflush(stdout);
    if (count > 0)
        frames_left = count;
    while (frames_left > 0 && lcm_handle(lcm) == 0)
        ;
    lcm_destroy(queries);
    lcm_destroy(lcm);
    return 0;
}

/* The rest is for --vectors: any message as JSON. */

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
        const lcm_type_info_t *info = find_type(field->typestr);
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
    const lcm_type_info_t *info = find_type(type_name);
    if (!info) {
        printf("{\"error\": \"unknown type\"}\n");
        return;
    }
    void *message = calloc(1, info->struct_size());
    if (decode(info, data, size, message)) {
        print_struct(info, message);
        printf("\n");
        info->decode_cleanup(message);
    } else {
        printf("{\"error\": \"%zu bytes are not a whole %s\"}\n", size, type_name);
    }
    free(message);
}

/* Replace hexadecimal digits with the bytes that they stand for. Return how many there are; -1 for other characters. */
static ssize_t decode_hex(char *digits)
{
    ssize_t size = 0;
    for (; isxdigit((unsigned char)digits[2 * size]) && isxdigit((unsigned char)digits[2 * size + 1]); size++)
        digits[size] = (char)strtol((char[]){digits[2 * size], digits[2 * size + 1], '\0'}, NULL, 16);
    return digits[2 * size] == '\0' ? size : -1;
}

/* Read lines TYPE HEX. */
static int print_vectors(void)
{
    char *line = NULL;
    size_t capacity = 0;
    while (getline(&line, &capacity, stdin) > 0) {
        const char *type_name = strtok(line, " \r\n");
        char *digits = strtok(NULL, " \r\n");
        const ssize_t size = digits ? decode_hex(digits) : 0;
        if (size < 0)
            printf("{\"error\": \"this is not hexadecimal\"}\n");
        else
            print_vector(type_name ? type_name : "", (const uint8_t *)digits, (size_t)size);
    }
    free(line);
    return 0;
}

int main(int argc, char **argv)
{
    setlocale(LC_CTYPE, "C.UTF-8"); /* the gateway's texts are UTF-8 */
    if (argc > 1 && strcmp(argv[1], "--vectors") == 0)
        return print_vectors();
    if (argc > 1 && argv[1][0] == '-') {
        printf("Print the markers and events that a gateway publishes on LCM.\n"
               "Usage: %s [SOURCE [COUNT]]\n       %s --vectors < LINES\n",
               argv[0], argv[0]);
        return strcmp(argv[1], "--help") == 0 ? 0 : 2;
    }
    char *end = "";
    const long count = argc > 2 ? strtol(argv[2], &end, 10) : 0;
    if (*end || count < 0) {
        fprintf(stderr, "COUNT must be a number, not %s\n", argv[2]);
        return 1;
    }
    return subscribe(argc > 1 ? argv[1] : "LAB", count);
}
