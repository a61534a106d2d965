// Reads or writes the bytes of messages on a topic with Fast DDS, the DDS that ROS 2 uses by default, on this computer alone:
//     fast_dds read|write DOMAIN TOPIC TYPE SECONDS
// Messages come from stdin or go to stdout, each after its length (uint32).
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>
#include <chrono>
#include <cstdio>
#include <cstring>
#include <string>
#include <thread>
#include <vector>
using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;
using Bytes = std::vector<unsigned char>;
struct Raw : TopicDataType {
    Raw(const std::string& name) { setName(name.c_str()); m_typeSize = 2000000; m_isGetKeyDefined = false; auto_fill_type_object(false); auto_fill_type_information(false); }
    bool serialize(void* data, SerializedPayload_t* p) override { auto& b = *static_cast<Bytes*>(data); memcpy(p->data, b.data(), b.size()); p->length = b.size(); p->encapsulation = 1; return true; }
    bool deserialize(SerializedPayload_t* p, void* data) override { static_cast<Bytes*>(data)->assign(p->data, p->data + p->length); return true; }
    std::function<uint32_t()> getSerializedSizeProvider(void* data) override { return [data] { return (uint32_t)static_cast<Bytes*>(data)->size(); }; }
    void* createData() override { return new Bytes; }
    void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
    bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};
int main(int, char** a) {
    DomainParticipantQos here = PARTICIPANT_QOS_DEFAULT;
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.push_back("127.0.0.1");
    here.transport().use_builtin_transports = false;
    here.transport().user_transports.push_back(udp);
    eprosima::fastrtps::rtps::Locator_t peer;
    eprosima::fastrtps::rtps::IPLocator::setIPv4(peer, "127.0.0.1");
    here.wire_protocol().builtin.initialPeersList.push_back(peer);
    auto* part = DomainParticipantFactory::get_instance()->create_participant(std::stoi(a[2]), here);
    TypeSupport type(new Raw(a[4])); type.register_type(part);
    auto* topic = part->create_topic(a[3], a[4], TOPIC_QOS_DEFAULT);
    double seconds = std::stod(a[5]);
    auto end = std::chrono::steady_clock::now() + std::chrono::milliseconds(int(1000 * seconds));
    if (!strcmp(a[1], "read")) {
        DataReaderQos q; q.reliability().kind = BEST_EFFORT_RELIABILITY_QOS; q.history().depth = 5;
        auto* reader = part->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, q);
        while (std::chrono::steady_clock::now() < end) {
            Bytes b; SampleInfo info;
            if (reader->take_next_sample(&b, &info) == ReturnCode_t::RETCODE_OK) { if (info.valid_data) { uint32_t n = b.size(); fwrite(&n, 4, 1, stdout); fwrite(b.data(), 1, n, stdout); fflush(stdout); } }
            else std::this_thread::sleep_for(std::chrono::milliseconds(2));
        }
    } else {
        DataWriterQos q; q.reliability().kind = BEST_EFFORT_RELIABILITY_QOS; q.history().depth = 5; q.endpoint().history_memory_policy = eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
        auto* writer = part->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(topic, q);
        uint32_t n;
        while (fread(&n, 4, 1, stdin) == 1) { Bytes b(n); if (fread(b.data(), 1, n, stdin) != n) break; writer->write(&b); }
        std::this_thread::sleep_until(end);
    }
    return 0;
}
